"""The simulated machine: its true geometry, motion and measurement noise."""
