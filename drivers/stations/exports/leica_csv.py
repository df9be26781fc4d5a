"""Text exports of Leica's total stations and trackers: `PtID`, `East`, `North`, `Height`, or `Point`, `X`, `Y`, `Z`."""

from __future__ import annotations

import re

from drivers.stations.tables.delimited import delimited_format

_MARKS = re.compile(r"\b(leica|hexagon|captivate|infinity|emscon|axyz|pt ?id|point ?id)\b", re.IGNORECASE)


def _recognises(text: str) -> bool:
    return bool(_MARKS.search(text[:4000]))


FORMAT = delimited_format("leica_csv", "Leica text export", 40, _recognises)
