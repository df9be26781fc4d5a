"""Effects that a library of physical effects names, in files by the place at which they act."""
