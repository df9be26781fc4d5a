"""`rigcal report`: finds the report of a model, and converts it to PDF."""

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
    help="Directory of `rigcal calibrate`, of `rigcal gap` or of a job, or the HTML page itself.",
)
@click.option(
    "--pdf",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OUT",
    help="Write the report to this PDF file, as numbered A4 pages. Requires Pango and the `pdf` extra: pip install "
    "'rigcal[pdf]'.",
)
@json_option
def report(path: Path, pdf: Path | None, *, as_json: bool) -> dict[str, str]:
    """Show the path of a model's report, or write the report as PDF.

    `rigcal jobs list` shows the reports of jobs. The HTML page can also be printed from any browser.
    """
    from drivers.files import read_text

    page = path / REPORT if path.is_dir() else path
    if not page.is_file():
        raise CommandError(f"{page} is not a report; `rigcal jobs list` shows the reports of jobs")
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
