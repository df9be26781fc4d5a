"""`rigcal report`: the report of a model, also as PDF."""

from __future__ import annotations

from pathlib import Path

import click

from daemon.cli.command import Command, json_option
from daemon.cli.terminal import echo
from daemon.commands import FAILED, CommandError
from daemon.host.safe_output import write_file

REPORT = "report.html"
LONGEST_BYTES = 256 << 20


@click.command(cls=Command)
@click.option(
    "--model",
    "path",
    type=click.Path(path_type=Path),
    required=True,
    metavar="DIR",
    help="What calibrate or gap wrote, a job's directory, or the HTML page itself.",
)
@click.option(
    "--pdf",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OUT",
    help="Write the report as PDF: numbered A4 pages. Needs the extra `pdf`: pip install 'rigcal[pdf]', and Pango.",
)
@json_option
def report(path: Path, pdf: Path | None, *, as_json: bool) -> dict[str, str]:
    """Say where the report of a model is, and write it as PDF.

    `rigcal jobs list` names the reports of jobs. The HTML page prints well from any browser, too.
    """
    from drivers.files import read_text

    page = path / REPORT if path.is_dir() else path
    if not page.is_file():
        raise CommandError(f"{page} is no report; `rigcal jobs list` names those of jobs")
    told = {"html": str(page)}
    if pdf is not None:
        from daemon.report.pdf import PdfError, pdf_of

        try:
            document = pdf_of(read_text(page, LONGEST_BYTES))
        except PdfError as error:
            raise CommandError(str(error), FAILED) from error
        write_file(pdf, document)
        told["pdf"] = str(pdf)
    if not as_json:
        for file in told.values():
            echo(file)
    return told
