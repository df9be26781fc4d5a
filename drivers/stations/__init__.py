"""Total stations on serial lines."""
