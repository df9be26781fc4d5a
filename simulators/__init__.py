"""A rig made of protocol-true devices with known, hidden imperfections, and replay of captured ones."""
