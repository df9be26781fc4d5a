"""Rig files from the descriptions that other programs have: URDF and Denavit-Hartenberg tables."""
