"""Topcon total stations: the "GTS" serial protocol of the classic series and of the GTS-8 tracking family."""
