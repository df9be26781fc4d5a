"""Experimental design: the choice of poses that determine a model best."""
