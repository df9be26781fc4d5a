"""Effects that the library of physical effects contains, in modules by the place at which they act."""
