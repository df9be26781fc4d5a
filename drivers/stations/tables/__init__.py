"""Tables of measured points, as instruments and people export them: cells, columns, units, and guesses of them."""
