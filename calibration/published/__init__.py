"""Published methods, implemented as in their papers, for comparison with the default method."""
