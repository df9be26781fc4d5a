"""Export of models: the formats, one per file in `formats`, and the code that several formats share."""
