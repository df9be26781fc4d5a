"""Forward kinematics of any rig, compiled, with Jacobians and gravity loads."""
