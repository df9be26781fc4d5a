"""The "GTS" serial protocol of Topcon total stations: the classic series and the GTS-8 tracking family."""
