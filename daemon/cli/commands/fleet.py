"""`rigcal fleet`: calibrates many rigs and compares them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.offline import Stopwatch, prior_option, seed_option
from daemon.cli.terminal import echo
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from daemon.fleet.run import Engine

CONNECT_TIMEOUT_S = 10.0


@click.command(cls=Command)
@click.argument("directories", nargs=-1, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--stores", metavar="GLOB", help="Stores of daemons, as a quoted pattern: 'rigs/*/rigcal.sqlite'.")
@click.option("--rig", metavar="RIG", help="Shipped rig, or path of a rig file, for directories without a rig.toml.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Directory of the result.")
@click.option("--gap/--no-gap", default=True, show_default=True, help="Search for effects that the models lack.")
@click.option(
    "--workers",
    type=click.IntRange(1),
    help="Number of worker processes on this computer (requires the `dask` extra); none by default.",
)
@click.option("--scheduler", metavar="ADDRESS", help="Address of a dask scheduler whose workers do the work.")
@prior_option
@seed_option
@json_option
def fleet(
    directories: tuple[Path, ...],
    stores: str | None,
    rig: str | None,
    out: Path,
    gap: bool,
    workers: int | None,
    scheduler: str | None,
    prior: str,
    seed: int,
    *,
    as_json: bool,
) -> dict[str, Any]:
    """Calibrate every rig of a fleet and compare them.

    Each of DIRECTORIES is one rig: a daemon's state directory, or CSV files of observations with a rig.toml. The result
    is fleet.html, fleet.parquet and a file for each rig in rigs/. If the command is repeated, it works only on rigs
    that are not done or whose data have changed. A rig that cannot be assessed is listed with the reason.
    """
    watch = Stopwatch()
    prepare()
    from daemon.fleet.assess import FleetSettings
    from daemon.fleet.comparison import compare
    from daemon.fleet.report import fleet_report
    from daemon.fleet.run import assess_all
    from daemon.fleet.sources import find_rigs
    from daemon.fleet.table import write_table
    from daemon.host.safe_output import write_file

    if workers is not None and scheduler is not None:
        raise click.UsageError("give --workers or --scheduler, not both")
    sources = find_rigs(directories, stores, rig)
    with _engine(workers, scheduler) as engine, progress_display(as_json=as_json) as progress:

        def told(done: int, of: int, name: str) -> None:
            progress(done / of, f"{done} of {of} rigs, {name}")

        answers = assess_all(sources, FleetSettings(gap, prior, seed), out, engine, told)
    compared = compare(answers)
    table = write_table(compared, out)
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    page = out / "fleet.html"
    kept = [f"{table.name}: all rigs and quantities", "rigs/: the result of each rig, as JSON"]
    write_file(page, fleet_report(compared, made, kept).encode())
    assessed = sum(len(group.answers) for group in compared.groups)
    outliers = [
        answer["name"] for group in compared.groups for n, answer in enumerate(group.answers) if group.outlying(n)
    ]
    common: list[dict[str, Any]] = [
        {"rig": q.rig, "quantity": q.name, "unit": q.unit, "mean": q.fleet.mean, "sigma": q.fleet.mean_sigma}
        for group in compared.groups
        for q in group.common
    ]
    if not as_json:
        echo(f"{assessed} rigs assessed, {len(compared.failed)} not, in {watch.seconds:.0f} s")
        for failed in compared.failed[:10]:
            echo(f"  {failed['name']}: {failed['error']}", fg="red")
        echo(f"common deviations: {', '.join(item['quantity'] for item in common[:10]) or 'none'}")
        echo(f"outliers: {', '.join(outliers[:10]) or 'none'}")
        echo(f"{page}, {table}")
    return {
        "rigs": assessed,
        "failed": {answer["name"]: answer["error"] for answer in compared.failed},
        "common": common,
        "outliers": outliers,
        "report": str(page),
        "table": str(table),
        "seconds": watch.seconds,
    }


@contextlib.contextmanager
def _engine(workers: int | None, scheduler: str | None) -> Iterator[Engine]:
    """Yield what carries out the work: this process, its own worker processes, or a cluster."""
    from daemon.fleet.run import Cluster, Here, local_workers

    try:
        if scheduler is not None:
            from distributed import Client

            try:
                client = Client(scheduler, timeout=CONNECT_TIMEOUT_S)
            except (OSError, ValueError) as error:
                raise click.BadParameter(
                    f"no dask scheduler at {scheduler}: {error}", param_hint="--scheduler"
                ) from error
            with client:
                yield Cluster(client)
        elif workers is not None:
            with local_workers(workers) as client:
                yield Cluster(client)
        else:
            yield Here()
    except ImportError as error:
        raise click.UsageError("the `dask` extra is not installed: pip install 'rigcal[dask]'") from error
