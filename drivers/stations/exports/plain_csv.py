"""Tables of any origin: with a header that names coordinates, or angles and slope distance; or just point, x, y, z."""

from __future__ import annotations

from drivers.stations.tables.delimited import delimited_format

FORMAT = delimited_format("plain_csv", "table of points", 90, lambda text: bool(text.strip()))
