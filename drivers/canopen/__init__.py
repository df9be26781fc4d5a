"""CANopen: the base protocol (CiA 301) and the device profiles of encoders and transducers."""
