"""HTML reports: calibration, gap, comparison of methods, and the experiments of Zhou et al. 2022."""
