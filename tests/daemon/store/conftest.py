"""A store with a session."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from daemon.store import Store
from daemon.store.queries.observations import ObservationTable
from daemon.store.queries.sessions import SessionTable
from drivers.readings import Status
from tests.daemon.support.store import at, fix, reading


@pytest.fixture
def session_path(tmp_path: Path) -> Path:
    """A store with a session of ten seconds, a second of it at 10 Hz."""
    path = tmp_path / "rigcal.sqlite"
    with contextlib.closing(Store(path)) as store:
        store.declare_channels({"theta1": "deg", "L2": "mm"}, {"oil": "degC", "flow": "l/min"})
        store.insert("links", {"name": "ts1", "kind": "serial"})
        records = [reading("theta1", n / 10, float(n)) for n in range(100)]
        records.append(reading("L2", 4.0, 1500.0, "mm"))
        records.append(reading("theta1", 4.05, None, status=Status.MALFORMED))
        store.insert_records([*records, fix(4.0), fix(90.0)])
        table, observations = SessionTable(store, "swdt82"), ObservationTable(store)
        table.start(at(3.0), "name = 1\n", id="s001-r", prism="r", operator="Ada", kind="static_poses")
        values = {"theta1_deg": 40.0, "theta1_dir": 1.0, "L2_mm": 1500.0, "oil_degC": 61.5, "flow_l_per_min": 12.0}
        place = {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0, "moving": 0}
        row = {"session_id": "s001-r", "prism": "r", "pose": "1", "values_json": values, **place}
        observations.add(1, at(4.0), **row)
        observations.add(None, at(5.0), **{**row, "x_mm": 3.0})
        observations.add(None, at(6.0), **row, excluded="moving")
        table.change("s001-r", state="closed", **store.instant(at(13.0), "ended_"))
    return path
