"""The effect families, one file each; `calibration.effects.library` finds them by walking this package."""
