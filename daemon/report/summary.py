"""The report in one picture: headline, before and after per prism, and where what is left lies."""

from __future__ import annotations

import textwrap

from daemon.plain_text import shown
from daemon.report.build import headline
from daemon.report.drawing import AFTER, BEFORE, LABEL_CHARACTERS, SOFT, new_figure, png_bytes, styled
from daemon.report.figures import draw_error_map, draw_errors_by_prism
from daemon.report.inputs import STAGES, ReportInput
from daemon.report.markup import number

_TITLE_CHARACTERS = 92


def summary_png(report: ReportInput) -> bytes:
    """A PNG of about 1500 x 1000 pixels, for a README or a message."""
    with styled():
        figure = new_figure(7.0, 10.5)
        # matplotlib's own wrapping takes what stands between dollar signs for a formula, whatever it was told.
        title = textwrap.fill(f"{shown(report.rig, LABEL_CHARACTERS)}. {headline(report)}", _TITLE_CHARACTERS)
        figure.suptitle(title, x=0.012, ha="left", fontsize=13, fontweight="bold")
        halves = figure.subfigures(2, 1, height_ratios=[1.0, 1.05], squeeze=False)
        top, bottom = halves[0, 0], halves[1, 0]
        stages, prisms = top.subplots(1, 2, width_ratios=[0.85, 1.4])
        values = [report.judged.stage(stage).rms_mm for stage in STAGES]
        bars = stages.barh(range(len(STAGES)), values, height=0.6, color=[BEFORE, AFTER, AFTER, AFTER])
        stages.bar_label(bars, labels=[f"{number(v)} mm" for v in values], padding=3, fontsize=9)
        stages.axvline(report.instrument_mm, color=SOFT, linewidth=1, linestyle=(0, (4, 3)))
        stages.set_yticks(range(len(STAGES)), list(STAGES))
        stages.invert_yaxis()
        stages.set_xlim(0, max(values) * 1.28)
        stages.grid(False, axis="y")
        stages.set_xlabel(f"mm; dashed: instrument noise, {number(report.instrument_mm)} mm")
        stages.set_title("Root mean square error, stage by stage")
        draw_errors_by_prism(prisms, report)
        prisms.set_title("Every fix before (grey) and after (blue)")
        draw_error_map(bottom, report)
        return png_bytes(figure)
