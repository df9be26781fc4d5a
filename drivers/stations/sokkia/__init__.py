"""Sokkia total stations and the newer Topcon ones of the same command family: the SET two-way protocol."""
