"""`rigcal rig`: checks, imports and exports rig files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from calibration.rig.words import counted
from daemon.cli.command import WRONG_INPUT, Command, json_option, out_file_option
from daemon.cli.lines.fill_in import fill_in_lines, fill_in_note
from daemon.cli.offline import FILE
from daemon.cli.terminal import echo, echo_error, echo_list, echo_table
from daemon.commands import CommandError
from daemon.host.safe_output import write_file
from daemon.report.words import number

if TYPE_CHECKING:
    from calibration.design.rig_check import RigCheck

_CONVENTIONS = ("dh", "mdh_beta_after", "mdh_beta_before")
_FAULTS_SHOWN = 20


@click.group()
def rig() -> None:
    """Check, import and export rig files.

    They are converted from or to URDF and Denavit-Hartenberg tables.
    """


@rig.command("check", cls=Command)
@click.argument("path", metavar="FILE")
@click.option("--svg", type=click.Path(dir_okay=False, path_type=Path), metavar="OUT", help="SVG drawing of the chain.")
@json_option
def rig_check(path: str, svg: Path | None, *, as_json: bool) -> dict[str, Any]:
    """Check a rig file and show the machine that it describes.

    FILE may also be the name of a shipped rig. All errors are reported with their lines. For a valid file the output
    has the positions of frames and prisms with all joints at zero, a drawing of the chain, the reach, the radii of
    links that `rigcal plan` keeps clear of, the parameters that fixes in poses all over the joint limits determine, and
    the lines that `rigcal init` marked FILL IN.
    """
    from calibration.design.rig_check import check_rig
    from calibration.rig.description import read_rig
    from daemon.rig_files import read_rig_text

    if Path(path).suffix.lower() in (".csv", ".urdf", ".xacro", ".xml") and Path(path).is_file():
        raise CommandError(
            f"{path}: not a rig file (TOML); `rigcal rig import {path} --out RIG.toml` makes one from it", WRONG_INPUT
        )
    text, name, _ = read_rig_text(path)
    rig, faults = read_rig(text, name)
    if rig is None:
        for fault in sorted(faults[1:_FAULTS_SHOWN], key=lambda f: f.line or 0) if not as_json else ():
            echo_error(str(fault))
        raise faults[0]
    found = check_rig(rig)
    result: dict[str, Any] = found.as_dict() | {"fill_in": fill_in_lines(text)}
    if svg is not None:
        from daemon.report.chain_drawing import chain_svg

        poses = {"zero pose": found.zero, "middle of the limits": found.middle}
        write_file(svg, chain_svg(poses, found.at, f"{rig.name}: {len(rig.rows)} rows, {len(rig.joints)} joints"))
        result["svg"] = str(svg)
    if not as_json:
        _show(found, fill_in_note(text))
        if svg is not None:
            echo(f"Drawing: {svg}")
    return result


@rig.command("import", cls=Command)
@click.argument("path", type=FILE, metavar="FILE")
@click.option("--base", metavar="LINK", help="Base link of the rig; the URDF's root by default.")
@click.option(
    "--tip",
    "tips",
    multiple=True,
    metavar="LINK",
    help="Link that carries a prism; the end of every chain by default. May be repeated.",
)
@click.option(
    "--convention",
    type=click.Choice(_CONVENTIONS),
    help="Convention of a table; by default as stated in the table, or else standard (dh).",
)
@out_file_option("RIG.toml", "Rig file to write; an existing file is never overwritten.")
@json_option
def rig_import(
    path: Path, base: str | None, tips: tuple[str, ...], convention: Any, out: Path, *, as_json: bool
) -> dict[str, Any]:
    """Make a rig file from a URDF or a table.

    FILE is a URDF (also the output of xacro) or a Denavit-Hartenberg table (CSV). Taken from a URDF are joints with
    limits and rates, mimic joints as couplings, fixed transforms, prismatic joints, branches, masses, centres of
    gravity and inertias. Values that it lacks (errors of encoders, build tolerances, the station, the positions of
    prisms) are assumed and marked as such in the rig file. docs/how-to/import-arm.md lists the columns of a table.
    """
    from calibration.errors import RigError
    from calibration.rig.exchange.from_table import draft_of_table
    from calibration.rig.exchange.from_urdf import draft_of_urdf
    from calibration.rig.exchange.urdf import LONGEST, parse_urdf
    from drivers.files import read_text

    if path.suffix.lower() == ".toml":
        raise CommandError(f"{path}: already a rig file (TOML); `rigcal rig check {path}` checks it", WRONG_INPUT)
    if out.exists():
        raise CommandError(f"{out} exists and is not overwritten; name a different file, or remove it")
    is_table = path.suffix.lower() == ".csv"
    if is_table and (base or tips):
        raise click.UsageError("--base and --tip name links of a URDF; omit them for a table (CSV)")
    if not is_table and convention:
        raise click.UsageError("--convention is for a table (CSV); omit it for a URDF")
    try:
        text = read_text(path, LONGEST)
    except UnicodeDecodeError as error:
        raise RigError(str(path), "", "not UTF-8 text") from error
    draft = (
        draft_of_table(text, path.name, convention)
        if is_table
        else draft_of_urdf(parse_urdf(text, path.name), path.name, base, tips)
    )
    made = draft.rig()
    write_file(out, draft.text().encode("utf-8"))
    if not as_json:
        echo(
            f"{out}: {len(made.rows)} rows, joints {', '.join(made.joint_names)}, prisms {', '.join(made.prism_names)}"
        )
        echo_list("Please note", draft.notes)
        echo(f"`rigcal rig check {out}` shows it.")
    return {
        "out": str(out),
        "rig": made.name,
        "joints": list(made.joint_names),
        "prisms": list(made.prism_names),
        "rows": len(made.rows),
        "masses": len(made.masses),
        "notes": draft.notes,
    }


@rig.command("export", cls=Command)
@click.argument("path", metavar="FILE")
@out_file_option("OUT", "File to write; .urdf, .xacro, or .csv for a Denavit-Hartenberg table.")
@json_option
def rig_export(path: str, out: Path, *, as_json: bool) -> dict[str, Any]:
    """Write a rig as URDF, xacro or Denavit-Hartenberg table.

    FILE is a rig file or the name of a shipped rig. The result is the machine according to its drawings; `rigcal model
    export` writes the result of a calibration.
    """
    import numpy as np

    from calibration.export.formats import formats
    from calibration.kinematics.chain import Chain, Placement
    from daemon.rig_files import load_rig

    writers = {Path(made.file).suffix: made.rig_text for made in formats().values() if made.rig_text is not None}
    if out.suffix not in writers:
        raise click.UsageError(f"--out must end in one of {', '.join(writers)}, but {out.name} does not")
    rig = load_rig(path).rig
    chain = Chain(rig, {"": Placement.identity()})
    text = writers[out.suffix](chain, np.zeros(len(chain)), [f"Made by `rigcal rig export` from {Path(path).name}."])
    write_file(out, text.encode("utf-8"))
    if not as_json:
        echo(str(out))
    return {"rig": rig.name, "out": str(out)}


def _show(found: RigCheck, fill_in: str) -> None:
    from daemon.cli.lines.sketch import sketch
    from daemon.report.drawing import forward_axis

    rig, seen = found.rig, found.seen
    parts = [counted(len(own), noun) for own, noun in ((rig.rows, "row"), (rig.joints, "joint"), (rig.prisms, "prism"))]
    echo(f"{rig.name}: valid: {', '.join(parts)}", bold=True)
    places = [(f"frame {n}", place) for n, place in enumerate(found.zero.frames_mm[0]) if n]
    places += [(f"prism {name}", place) for name, place in zip(rig.prism_names, found.zero.prisms_mm[0], strict=True)]
    radii = {f"frame {link.row}": link for link in found.links}
    rows = []
    for name, place in places:
        link = radii.get(name)
        radius = "" if link is None else f"{link.radius_mm:.0f}{' assumed' if link.is_assumed else ''}"
        rows.append([name, *(f"{x + 0.0:.3f}" for x in place.round(6)), radius])
    header = ("", "x", "y", "z", "radius of its link")
    echo_table(header, rows, title="With all joints at zero, mm in the base frame", text_columns=(0,))
    forward = forward_axis(found.middle.prisms_mm[0])
    views = (("From the side", (forward, 2), f"{'xy'[forward]} to the right, z up"), ("From above", (0, 1), "x, y"))
    for title, across, words in views:
        echo(f"{title}, in the middle of the limits ({words}; # base, digits frames, * prisms):", bold=True)
        for line in sketch(found.middle, across):
            echo(f"  {line}")
    echo(
        f"Reach {found.at.reach_mm:.0f} mm; {found.free_share:.0%} of the poses within the limits are free of contact "
        f"with machine, base and floor"
    )
    echo(
        f"{seen.rank} of {seen.parameters} parameters determined by all prisms in {found.poses} poses all over the "
        f"limits, seen from a station {number(float((found.at.station_mm**2).sum() ** 0.5) / 1e3)} m away"
    )
    echo_list("Not determined", seen.unidentifiable)
    echo_list("Please note", [*filter(None, [fill_in]), *found.warnings])
