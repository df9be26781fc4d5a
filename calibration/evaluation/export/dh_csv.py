"""dh.csv: the identified constants as a Denavit-Hartenberg table, mm and deg, which `rigcal rig import` reads too."""

from __future__ import annotations

from calibration.evaluation.exports import Export, Format
from calibration.evaluation.writers.dh_table import dh_text


def _content(export: Export) -> bytes:
    model = export.model
    return dh_text(model.chain, model.values, export.heading(export.kinematics_alone)).encode()


FORMAT = Format(
    "dh-csv", "dh.csv", "the identified Denavit-Hartenberg constants", _content, lambda export: export.kinematics_alone
)
