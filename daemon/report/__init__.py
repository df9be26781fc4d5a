"""The calibration report: one self-contained HTML file, and one picture."""

from daemon.report.build import build_report, headline
from daemon.report.inputs import ReportInput
from daemon.report.summary import summary_png

__all__ = ["ReportInput", "build_report", "headline", "summary_png"]
