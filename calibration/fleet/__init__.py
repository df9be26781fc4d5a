"""Joint analysis of many rigs of one kind: their common mean, their spread, and outliers."""
