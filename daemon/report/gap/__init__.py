"""The gap report: its sentences, its figures and its page."""
