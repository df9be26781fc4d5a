"""The experiments of the first paper's section 4 (Zhou et al. 2022) on any data of any rig."""
