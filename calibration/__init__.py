"""The mathematics of calibration: arrays in, arrays out; no I/O, no clock, no threads other than its own.

Inside this package lengths are mm and angles rad; readings keep the unit of their column (deg or mm) until
`kinematics` converts them to chain values.
"""
