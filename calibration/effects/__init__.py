"""Named physical effects: deviations of a machine from rigid kinematics with exact joint readings."""
