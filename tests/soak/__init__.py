"""The soak: the daemon on a simulated rig for half an hour, with every fault at random (`python -m tests.soak`)."""
