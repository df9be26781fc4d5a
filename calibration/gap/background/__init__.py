"""Identification of effects in the presence of a background: smooth errors without a name, fitted simultaneously."""
