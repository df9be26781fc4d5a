"""Text exports of FARO trackers and CAM2: a preamble with units, then a name and X, Y, Z per line."""

from __future__ import annotations

import re

from drivers.stations.tables.delimited import delimited_format

_MARKS = re.compile(r"\b(faro|cam2|vantage)\b", re.IGNORECASE)


def _recognises(text: str) -> bool:
    return bool(_MARKS.search(text[:4000]))


FORMAT = delimited_format("faro_csv", "FARO text export", 30, _recognises)
