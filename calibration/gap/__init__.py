"""The gap workflow: where simulation and measurement disagree, which effect is missing, and how much it explains."""
