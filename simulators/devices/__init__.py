"""The devices of a simulated rig, speaking their real protocols."""
