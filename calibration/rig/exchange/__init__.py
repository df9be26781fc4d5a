"""Rig files from descriptions of other programs: URDF and Denavit-Hartenberg tables."""
