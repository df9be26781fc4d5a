"""Device drivers: bytes in, readings out. They depend neither on the daemon nor on the calibration mathematics.

Every driver has two halves: a pure decoder (captured bytes -> records of `drivers.readings`) and a thin loop that
owns one port, timestamps what it reads and passes it on unchanged.
"""
