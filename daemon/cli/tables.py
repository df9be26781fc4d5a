"""The tables that commands print for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from daemon.report.markup import number

_SHOWN = 10


def stage_table(result: Mapping[str, Any], title: str | None = None) -> Table:
    """Errors stage by stage, of all rows and of each prism's, from the contract's result of an evaluation."""
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("stage", no_wrap=True)
    for name in ("mean", "rms", "max", "std"):
        table.add_column(name, justify="right", no_wrap=True)
    for prism in result["per_prism"]:
        table.add_column(f"rms {prism}", justify="right", style="dim")
    for i, stage in enumerate(result["stages"]):
        cells = [number(stage[f"{name}_mm"]) for name in ("mean", "rms", "max", "std")]
        cells += [number(stages[i]["rms_mm"]) for stages in result["per_prism"].values()]
        table.add_row(stage["stage"], *cells, style="bold" if stage["stage"] == "hybrid" else None)
    return table


def show_evaluation(console: Console, result: Mapping[str, Any], what: str) -> None:
    """Print the contract's result of `calibrate` or `evaluate`.

    Args:
        console: where to.
        result: the JSON object.
        what: which rows the errors are of, e.g. "the 250 fixes it was fitted to".
    """
    console.print(stage_table(result, f"Position error in mm on {what}"))
    seen = result["identifiability"]
    effects = ", ".join(f"{e['family']}@{e['where']}" for e in result["effects"])
    console.print(
        f"scatter of a fix {number(result['noise_mm'])} mm; effects: {effects or 'none'}; "
        f"learned residual: {result['residual'] or 'none'}; "
        f"{seen['rank']} of {seen['parameters']} parameters determined by the data",
        highlight=False,
    )
    covered = result["intervals"]
    axes = ", ".join(f"{share:.0%}" for share in covered["axis_coverage"])
    console.print(
        f"{covered['level']:.0%} intervals hold {axes} of the errors of x, y, z and {covered['radius_coverage']:.0%} "
        "of the 3-D ones",
        highlight=False,
    )
    expected = result["expected_accuracy"]
    if expected is not None:
        place = f" at set-up {expected['setup']!r}" if expected["setup"] else ""
        console.print(
            f"expected of the model itself over the work volume{place}: {number(expected['rms_mm'])} mm RMS, 95 % "
            f"within {number(expected['p95_mm'])} mm, {expected['where']}",
            highlight=False,
            markup=False,
        )
    if result["axes"]:
        console.print(_axis_table(result["axes"]))
    _sentences(console, "Not determined", seen["unidentifiable"])
    _sentences(console, "Please note", result["warnings"])
    if result["ignored_columns"]:
        console.print(f"Ignored columns: {', '.join(result['ignored_columns'])}", highlight=False, markup=False)


def _axis_table(axes: Sequence[Mapping[str, Any]]) -> Table:
    """The model held against single-joint sweeps: for each joint the sweep that disagrees most."""
    table = Table(title="Axes of single-joint sweeps, measured against the model", title_justify="left")
    for name in ("joint", "prism", "angle, deg", "offset, mm", "by chance"):
        table.add_column(name, justify="left" if name in ("joint", "prism") else "right", no_wrap=True)
    for joint in dict.fromkeys(axis["joint"] for axis in axes):
        own = [axis for axis in axes if axis["joint"] == joint]
        worst = min(own, key=lambda axis: min(axis["p_axis"], axis["p_curve"]))
        cells = [
            f"{number(worst[name])} ± {number(worst[sigma])}"
            for name, sigma in (
                ("angle_deg", "angle_sigma_deg"),
                ("offset_mm", "offset_sigma_mm"),
            )
        ]
        chance = f"{min(worst['p_axis'], worst['p_curve']):.2g}"
        style = "bold" if worst["sentence"] else None
        table.add_row(joint, worst["prism"], *cells, chance, style=style)
    return table


def say(console: Console, text: str) -> None:
    """Print a line as it is."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def _sentences(console: Console, title: str, sentences: Sequence[str]) -> None:
    if not sentences:
        return
    console.print(f"{title}:", style="bold", highlight=False)
    for sentence in sentences[:_SHOWN]:
        console.print(f"  - {sentence}", highlight=False, markup=False)
    if len(sentences) > _SHOWN:
        console.print(f"  and {len(sentences) - _SHOWN} more (--json has all)", highlight=False)
