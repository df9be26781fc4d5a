"""Small numerical tools without knowledge of rigs."""
