"""What commands share that give an observations CSV back with columns of their own."""

from __future__ import annotations

import csv
import io
import logging
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import click

from calibration.observations import Floats
from daemon.cli.terminal import echo_error
from daemon.files import write_file
from daemon.plain_text import shown_lines


def check_out(out: Path | None, data: Path) -> None:
    """Refuse to write a result over the data that it is made from."""
    if out is not None and out.exists() and out.samefile(data):
        raise click.UsageError(f"{out} is the data itself; name another file with --out")


def with_columns(raw: bytes, columns: Mapping[str, Floats], dropped: Collection[str] = ()) -> str:
    """An observations CSV as it came, with some columns replaced and others added.

    Args:
        raw: the file's bytes, which `parse_observations` has read.
        columns: name -> (n,) numbers, put in place of a column of that name or else after all others.
        dropped: names of columns to leave out, where they are there.
    """
    reader = csv.reader(io.StringIO(raw.decode("utf-8-sig"), newline=""), strict=True)
    header, *rows = [row for row in reader if row]
    names = [name.strip() for name in header]
    keep = [i for i, name in enumerate(names) if name not in dropped]
    added = [name for name in columns if name not in names]
    cells = {name: [repr(float(value)) for value in values] for name, values in columns.items()}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(names[i] for i in keep), *added])
    for number, row in enumerate(rows):
        own = (cells[names[i]][number] if names[i] in cells else row[i] for i in keep)
        writer.writerow([*own, *(cells[name][number] for name in added)])
    return out.getvalue()


def deliver(table: str, result: dict[str, object], warnings: Sequence[str], out: Path | None, *, as_json: bool) -> None:
    """Give a table and warnings out: to the file, or into the JSON object as "csv", or to standard output.

    Args:
        table: the CSV.
        result: the JSON object, which is told where the table is.
        warnings: for people; in the object they are already.
        out: the file, None for none.
        as_json: whether standard output is the object's.
    """
    if out is not None:
        write_file(out, table.encode("utf-8"))
        result["out"] = str(out)
    elif as_json:
        result["csv"] = table
    else:
        click.echo(shown_lines(table) if sys.stdout.isatty() else table, nl=False)
    for warning in () if as_json else warnings:
        echo_error(f"Warning: {warning}", logging.WARNING)
