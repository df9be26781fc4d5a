"""Published methods, as their papers have them, to be held against the default."""
