"""Options that several commands have, spelled once."""

from __future__ import annotations

from pathlib import Path

import click

PRIORS = ("recalibration", "as-built")

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
DIRECTORY = click.Path(path_type=Path)

rig_option = click.option("--rig", required=True, metavar="RIG", help="Name of a shipped rig, or path of a rig file.")
data_option = click.option("--data", type=FILE, required=True, metavar="CSV", help="Observations, one row per fix.")
model_option = click.option(
    "--model", "directory", type=DIRECTORY, required=True, metavar="DIR", help="The directory calibrate wrote."
)
prior_option = click.option(
    "--prior",
    type=click.Choice(PRIORS),
    default="recalibration",
    show_default=True,
    help="Trust the rig's build tolerances, or estimate from the data how far off the drawings are.",
)
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of every random choice."
)
