"""`rigcal import`: converts an instrument's export to observations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from daemon.cli import offline
from daemon.cli.command import Command, json_option
from daemon.cli.terminal import echo


@click.command(cls=Command, name="import")
@click.argument("file", type=offline.FILE)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Observations file (CSV).")
@click.option("--map", "map_path", type=offline.FILE, help="Read FILE with this map, which an earlier import wrote.")
@click.option("--rig", metavar="RIG", help="Name of a shipped rig, or path of a rig file, for its prisms and joints.")
@click.option(
    "--joints",
    type=offline.FILE,
    help="CSV with a column for each joint (theta1_deg, ...) and a column pose (the point's number), time_s or time.",
)
@click.option("--prism", help="Prism of all points; by default taken from their codes or markers.")
@click.option("--setup", default="", help="Name of the station set-up; if FILE has several, the prefix of their names.")
@click.option("--session", default="", help="Session name for all rows; none by default.")
@json_option
def import_(
    file: Path,
    out: Path,
    map_path: Path | None,
    rig: str | None,
    joints: Path | None,
    prism: str | None,
    setup: str,
    session: str,
    *,
    as_json: bool,
) -> dict[str, Any]:
    """Convert an instrument's export to observations.

    FILE is an export of a tracker or total station. Formats: Topcon GTS memory downloads, Sokkia SDR33, Vicon
    trajectories, tables of Leica, FARO and others. Guesses about a table are shown and written to a map file next to
    the result; --map applies them again. A file with an error is refused as a whole, with line, column and reason.
    """
    from calibration.observations import parse_observations
    from daemon.cli.imported_points import (
        bare_times,
        far_repetitions,
        keep_map,
        observations_csv,
        prisms_of,
        read_export,
        read_joints,
        read_map,
        repeated_setups,
        setup_names,
        several_constants,
        several_setups,
        target_heights,
    )
    from daemon.host.safe_output import write_file
    from daemon.rig_files import load_rig
    from drivers.stations.exports import export_formats, format_of

    if joints is not None and rig is None:
        raise click.UsageError("--joints needs --rig, which names the joints")
    for given in (file, joints, map_path):
        if given is not None:
            offline.check_out(out, given)
    described = load_rig(rig).rig if rig is not None else None
    if prism and described is not None and prism not in described.prism_names:
        raise click.UsageError(
            f"rig {described.name!r} has no prism {prism!r}; it has {', '.join(described.prism_names)}"
        )
    text = read_export(file)
    notes: tuple[str, ...] = ()
    if map_path is not None:
        columns = read_map(map_path)
        known = export_formats()[columns.format]
    else:
        known = format_of(text, file.name)
        guess = known.guess(text, file.name)
        columns, notes = guess.map, guess.notes
    fixes = known.read(text, columns, file.name)
    notes += known.passed_over(text, file.name) + far_repetitions(fixes, file.name)
    rows = None if joints is None or described is None else read_joints(joints, described)
    setups = setup_names(fixes, setup)
    notes += several_setups(setups, file.name) + repeated_setups(fixes, file.name)
    prisms = prisms_of(fixes, columns, file.name, described, prism)
    notes += several_constants(fixes, prisms, file.name) + target_heights(fixes, file.name)
    notes += bare_times(fixes, rows, file.name)
    table = observations_csv(fixes, prisms, file.name, rows, setups, session)
    if described is not None and rows is not None:
        parse_observations(table.encode(), described, f"observations of {file.name}")
    saved = None
    if map_path is None:
        saved = out.with_name(f"{out.stem}.map.toml")
        keep_map(saved, columns, file.name)
    replaced = offline.replaced(out)
    write_file(out, table.encode())
    if not as_json:
        echo(f"{known.title}: {len(fixes)} points written to {out}{replaced}")
        for note in notes:
            echo(f"  {note}")
        if saved is not None:
            echo(f"the map is in {saved}; --map {saved} reads files in the same way")
        if rows is None:
            echo("the rows have no joint values; add them with --rig and --joints before you calibrate")
    return {
        "format": known.name,
        "points": len(fixes),
        "out": str(out),
        "map": columns.model_dump(exclude_defaults=True),
        "map_file": None if saved is None else str(saved),
        "notes": list(notes),
        "has_joints": rows is not None,
    }
