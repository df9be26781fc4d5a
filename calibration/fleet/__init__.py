"""Many rigs of one kind together: what they have in common, how much they differ, and which do not belong."""
