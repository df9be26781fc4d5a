"""The prism that is meant: which fixes are of it, from their own course, the boom's standstills and the joints."""
