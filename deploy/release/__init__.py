"""Makes wheel, sdist, Debian packages and whole releases of the last commit; the same commit gives the same bytes."""
