"""Bytes in, readings out: knows devices, knows nothing of the daemon or of the mathematics.

Every driver has two halves: a pure decoder (captured bytes -> records of `drivers.readings`) and a thin loop that
owns one port, stamps what it reads and hands it on as it came.
"""
