"""CAN devices of a simulated rig."""
