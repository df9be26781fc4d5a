"""Effects that a library of physical effects names, one file each."""
