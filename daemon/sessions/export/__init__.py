"""A stored session as files: captured logs with the operator's commands, and tables."""
