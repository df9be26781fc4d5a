"""What kinematics leave over, learned from the data and kept only where it helps on held-out groups."""
