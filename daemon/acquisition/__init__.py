"""Acquisition: from links to the store."""
