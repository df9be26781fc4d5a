"""The mathematics: arrays in, arrays out. No I/O, no clock, no threads that it does not own.

Inside this package lengths are mm and angles rad; readings keep the unit of their column (deg or mm) until
`kinematics` turns them into chain values.
"""
