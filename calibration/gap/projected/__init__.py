"""Columns of effects in the space of residuals from which the kinematics is projected out."""
