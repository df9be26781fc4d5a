"""Named physical effects: what a machine does that rigid kinematics with true readings do not."""
