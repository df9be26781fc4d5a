"""Composes drivers, simulators and calibration: configuration, acquisition, store, sessions, jobs, interfaces."""
