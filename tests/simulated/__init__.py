"""Data of a simulated rig for tests and benches: observations, runs, and captures of both links."""
