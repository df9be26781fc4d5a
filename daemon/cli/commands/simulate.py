"""`rigcal simulate`: simulates observations of a machine of any rig."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from calibration.rig.columns import LEAST_SIGMA_MM
from daemon.cli.command import Command, json_option, out_file_option
from daemon.cli.offline import FILE, FiniteRange, rig_option, seed_option
from daemon.cli.terminal import echo
from daemon.host.safe_output import write_file
from daemon.report.words import number

_MOST_POSES = 100_000


@click.command(cls=Command)
@rig_option
@click.option("--poses", type=click.IntRange(1, _MOST_POSES), required=True, metavar="N", help="Number of poses.")
@seed_option
@click.option(
    "--plan", type=FILE, metavar="CSV", help="Plan with the poses; random poses within the limits by default."
)
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="FAMILY@WHERE[:NAME=VALUE...]",
    help="Hidden effect of the machine; by default it has only build errors. `rigcal effects` lists them. May be "
    "repeated.",
)
@click.option(
    "--noise",
    "noise_mm",
    type=FiniteRange(min=LEAST_SIGMA_MM),
    metavar="MM",
    help="Standard deviation of each coordinate of a fix, also stated in the data; from the rig file's station by "
    "default.",
)
@click.option(
    "--recording",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    metavar="K",
    help="Number of the recording; a different number measures the same machine in different poses, as held-out data.",
)
@out_file_option("CSV", "Observations CSV to write.")
@click.option(
    "--truth",
    "truth_out",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="JSON",
    help="Also write the true machine to this file, to compare a calibration with it.",
)
@json_option
def simulate(
    rig: str,
    poses: int,
    seed: int,
    plan: Path | None,
    effects: tuple[str, ...],
    noise_mm: float | None,
    recording: int,
    out: Path,
    truth_out: Path | None,
    *,
    as_json: bool,
) -> dict[str, Any]:
    """Simulate observations of a machine.

    They are input for `rigcal calibrate` without any hardware. The seed draws a machine within the tolerances of the
    rig file; the given effects are added to it. It stands still in each pose and all prisms are measured, with random
    errors of station and encoders. Its physics share no code with the analysis.
    """
    from daemon.composition import simulated_campaign
    from daemon.rig_files import load_rig

    source = load_rig(rig)
    campaign = simulated_campaign(
        source.rig, poses, seed, plan=plan, effects=",".join(effects), noise_mm=noise_mm, recording=recording
    )
    observed = campaign.observations
    write_file(out, observed.csv_text().encode("utf-8"))
    result: dict[str, Any] = {
        "rig": source.rig.name,
        "poses": poses,
        "fixes": len(observed),
        "noise_rms_mm": observed.noise_rms_mm,
        "effects": list(effects),
        "out": str(out),
    }
    if truth_out is not None:
        write_file(truth_out, (json.dumps(campaign.truth_as_dict(), indent=1) + "\n").encode("utf-8"))
        result["truth"] = str(truth_out)
    if not as_json:
        echo(
            f"{out}: {len(observed)} fixes in {poses} poses; the error of any model is at least "
            f"{number(observed.noise_rms_mm)} mm RMS, the noise of station and encoders"
        )
        if truth_out is not None:
            echo(f"True machine: {truth_out}")
    return result
