"""HTML of all reports: style sheet and building blocks. Text from data or files is always escaped."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from daemon.host.safe_output import shown

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d2733; --soft: #5b6670; --line: #dfe4e8; --blue: #0072b2;
  --warn: #b3261e; --warn-paper: #fdf3f2; --good: #1b6e3c; --good-paper: #eef7f1; --plain-paper: #f4f6f8; }
@media screen and (prefers-color-scheme: dark) {
  :root { --paper: #14191f; --ink: #e8ecef; --soft: #a9b4bd; --line: #36414c; --blue: #6cb8e6; --warn: #ff9d92;
    --warn-paper: #331b1a; --good: #7fd6a1; --good-paper: #15291d; --plain-paper: #1d242c; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 2.5rem 1.5rem 4rem; }
header h1 + p { margin: 0; color: var(--soft); }
h1 { font-size: 1.05rem; font-weight: 600; margin: 0; letter-spacing: .01em; }
h2 { font-size: 1.3rem; line-height: 1.3; margin: 3rem 0 .4rem; padding-top: 1.1rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .3rem; }
p, ul { max-width: 46rem; margin: .4rem 0 .8rem; }
.facts { width: 100%; table-layout: fixed; margin: .8rem 0 1.2rem; border-top: 1px solid var(--line); }
.facts th, .facts td { text-align: left; padding: .22rem 1rem .22rem 0; font-size: .92rem; }
.facts th { width: 9rem; }
.facts td { white-space: normal; overflow-wrap: break-word; }
.verdict { max-width: none; padding: .55rem 1rem; border-left: 5px solid var(--line); background: var(--plain-paper);
  font-size: 1.1rem; font-weight: 600; }
.verdict.passed { border-color: var(--good); background: var(--good-paper); color: var(--good); }
.verdict.failed { border-color: var(--warn); background: var(--warn-paper); color: var(--warn); }
.accuracy { font-size: 1.08rem; }
.headline { font-size: 1.95rem; line-height: 1.25; font-weight: 700; letter-spacing: -.01em; margin: 1.4rem 0 .6rem;
  max-width: 50rem; }
.lead { font-size: 1.08rem; color: var(--soft); max-width: 46rem; }
.figures { display: grid; grid-template-columns: repeat(4, 1fr); gap: 1rem; margin: 1.6rem 0 .5rem; padding: 0; }
.figures div { border-top: 3px solid var(--line); padding-top: .5rem; }
.figures div.after { border-color: var(--blue); }
.figures dt { color: var(--soft); font-size: .88rem; line-height: 1.35; }
.figures dd { margin: 0; font-size: 1.7rem; font-weight: 700; font-variant-numeric: tabular-nums; white-space: nowrap; }
.figures small { font-size: .95rem; font-weight: 400; color: var(--soft); }
.notice { border-left: 4px solid var(--warn); background: var(--warn-paper); padding: .7rem 1rem; margin: 1.4rem 0;
  max-width: none; }
.notice ul { margin: .2rem 0 0; padding-left: 1.1rem; }
.note { color: var(--soft); font-size: .92rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .8rem 0 1rem; font-size: .94rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); font-size: .9rem; padding-bottom: .3rem; }
th, td { padding: .34rem .9rem .34rem 0; text-align: right; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--soft); font-size: .86rem; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td:not(.text) { white-space: nowrap; }
td.text { font-variant-numeric: normal; overflow-wrap: break-word; }
tr.best td { font-weight: 700; color: var(--blue); }
tr.flag td:last-child { color: var(--warn); font-weight: 600; }
figure { margin: 1rem 0 1.2rem; }
figure img { width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: .92rem; max-width: 46rem; margin-top: .3rem; }
code { font: .88em/1.4 ui-monospace, "DejaVu Sans Mono", monospace; }
.signatures { width: 100%; table-layout: fixed; margin-top: 3rem; border-spacing: 1.5rem 0; border-collapse: separate; }
.signatures td { border: 0; border-top: 1px solid var(--ink); padding: .3rem 0 0; text-align: left; font-size: .88rem;
  color: var(--soft); white-space: normal; }
@media (max-width: 40rem) { .figures { grid-template-columns: 1fr 1fr; } .headline { font-size: 1.5rem; } }
@media print {
  @page { size: A4; margin: 16mm 15mm 18mm;
    @bottom-left { content: string(report); font: 8pt "DejaVu Sans", sans-serif; color: #5b6670; }
    @bottom-right { content: "page " counter(page) " of " counter(pages); font: 8pt "DejaVu Sans", sans-serif;
      color: #5b6670; } }
  h1 { string-set: report content(); }
  html { font-size: 9.5pt; } body { font-size: 9.5pt; line-height: 1.4; } main { padding: 0; max-width: none; }
  p, ul, .headline, .lead, figcaption { max-width: none; }
  .figures { display: flex; } .figures div { flex: 1; }
  h1, h2, h3, caption, .keep > h2, .keep > p { break-after: avoid; }
  h2 { margin-top: 1.4rem; } thead { display: table-header-group; }
  figure, tr, .notice, .figures, .facts, .verdict, .signatures { break-inside: avoid; }
  figure { break-before: avoid; } p, li { orphans: 3; widows: 3; }
  figure img { max-height: 215mm; object-fit: contain; }
  details > * { display: block; } .scroll { overflow: visible; }
}
"""


def escape(text: object) -> str:
    """Escape text for use in HTML."""
    return html.escape(shown(text), quote=True)


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    text_columns: Sequence[int] = (0,),
    classes: Sequence[str] = (),
    caption: str = "",
) -> str:
    """Return a table of escaped cells.

    Args:
        header: headings of the columns; none if empty.
        rows: the cells.
        text_columns: indices of the left-aligned columns.
        classes: a CSS class for each row.
        caption: the line above the table.
    """
    head = "".join(f'<th{_text(i, text_columns)} scope="col">{escape(name)}</th>' for i, name in enumerate(header))
    body = []
    for line, row in enumerate(rows):
        kind = f' class="{classes[line]}"' if classes and classes[line] else ""
        cells = "".join(f"<td{_text(i, text_columns)}>{escape(cell)}</td>" for i, cell in enumerate(row))
        body.append(f"<tr{kind}>{cells}</tr>")
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    head = f"<thead><tr>{head}</tr></thead>" if header else ""
    return f'<div class="scroll"><table>{title}{head}<tbody>{"".join(body)}</tbody></table></div>'


def facts(lines: Mapping[str, str]) -> str:
    """Return a table with a row for each label and its text."""
    rows = "".join(f'<tr><th scope="row">{escape(k)}</th><td>{escape(text)}</td></tr>' for k, text in lines.items())
    return f'<table class="facts"><tbody>{rows}</tbody></table>'


def signature_block(roles: Sequence[str]) -> str:
    """Return a signature line for each role, with space for a name and a date."""
    cells = "".join(f"<td>{escape(role)}<br>name, date, signature</td>" for role in roles)
    return f'<table class="signatures"><tbody><tr>{cells}</tr></tbody></table>'


def _text(column: int, text_columns: Sequence[int]) -> str:
    return ' class="text"' if column in text_columns else ""


def section(title: str, *content: str) -> str:
    """Return a titled section; the content is HTML."""
    return f"<section><h2>{escape(title)}</h2>{''.join(content)}</section>"


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of escaped text."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def unbroken(paragraphs: str) -> str:
    """Return HTML without line breaks between a number and its mm."""
    return paragraphs.replace(" mm", "&nbsp;mm")


def items(sentences: Iterable[str]) -> str:
    """Return a list of escaped sentences."""
    return "<ul>" + "".join(f"<li>{escape(s)}</li>" for s in sentences) + "</ul>"


def details(title: str, content: str) -> str:
    """Return a section of HTML that unfolds on a click."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def notice(sentences: Sequence[str]) -> str:
    """Return a box of sentences; empty if there are none."""
    if not sentences:
        return ""
    return f'<div class="notice" role="note"><strong>Please note</strong>{items(sentences)}</div>'


class Tile(NamedTuple):
    """A figure in large type; the kind `after` highlights the result."""

    label: str
    value: str
    unit: str = "mm"
    kind: str = ""


def header(title: str, front: str, headline: str, lead: str, tiles: Iterable[Tile] = ()) -> str:
    """Return the top of a page.

    Args:
        title: title of the page.
        front: HTML below the title: the subject of the page.
        headline: the result in one sentence.
        lead: meaning of the result in a few sentences.
        tiles: figures of the result.
    """
    figures = "".join(
        f'<div class="{tile.kind}"><dt>{escape(tile.label)}</dt>'
        f"<dd>{escape(tile.value)} <small>{tile.unit}</small></dd></div>"
        for tile in tiles
    )
    return (
        f"<header><h1>{escape(title)}</h1>{front}"
        f'<p class="headline">{unbroken(escape(headline))}</p>{paragraph(lead, "lead")}'
        + (f'<dl class="figures">{figures}</dl></header>' if figures else "</header>")
    )


def sources_section(sources: Mapping[str, str], extra: str = "") -> str:
    """Return the last section of a page: label -> origin of data and model."""
    return section("Where this comes from", table((), list(sources.items()), text_columns=(0, 1)), extra)


def page(title: str, content: str) -> str:
    """Return the whole document: one file that loads nothing else."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body><main>{content}</main></body></html>\n"
    )
