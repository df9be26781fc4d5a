"""Tables of any origin: a header that names coordinates, or angles and a slope distance; or point, x, y, z alone."""

from __future__ import annotations

from drivers.stations.delimited import delimited_format

FORMAT = delimited_format("plain_csv", "table of points", 90, lambda text: bool(text.strip()))
