"""The devices of a simulated rig, which use their real protocols."""
