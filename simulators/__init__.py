"""A simulated rig of devices with true protocols and known, hidden imperfections, and replay of captured traffic."""
