"""Learners of the errors that kinematics and effects leave, kept only if they help on held-out groups."""
