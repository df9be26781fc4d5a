"""Generators of the pages of docs/reference that are made from the code: `python -m docs.references` runs them."""
