"""Learners of the error that kinematics leave over, kept only where they help on held-out groups."""
