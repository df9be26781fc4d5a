"""The description of a rig: joints, links, prisms, channels, limits."""
