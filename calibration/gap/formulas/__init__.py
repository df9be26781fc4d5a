"""Formulas for errors that no effect of the library explains."""
