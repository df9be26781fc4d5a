"""Export of models: formats, one a file in `formats`, and beside them what several formats share."""
