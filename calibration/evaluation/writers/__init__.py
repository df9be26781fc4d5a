"""Kinematics as other programs take them: text of URDF, Denavit-Hartenberg tables and C."""
