"""The experiments of section 4 of the first paper (Zhou et al. 2022), for any rig and data."""
