"""Columns of docs/reference/rig-keys.md are those that are read."""

from __future__ import annotations

from calibration.observations import parse_observations
from calibration.rig.columns import READ, SIGNALS
from calibration.rig.description import shipped_rig


def test_every_column_that_the_page_names_is_read() -> None:
    rig = shipped_rig("swdt82").with_signals("tilt_deg")
    named = {column.name for column in READ}
    signals = {column.name.replace("<signal>", "pump").replace("pump_<unit>", "tilt_deg") for column in SIGNALS}
    of_joints = {name.replace("<joint>", joint.name) for name in named for joint in rig.joints if "<joint>" in name}
    of_joints -= {f"{joint.name}_{'mm' if joint.unit == 'deg' else 'deg'}" for joint in rig.joints}
    columns = [*sorted({name for name in named if "<" not in name} | signals | of_joints)]
    row = ",".join("r" if name == "prism" else "1" for name in columns)
    assert parse_observations(f"{','.join(columns)}\n{row}\n".encode(), rig, "data.csv").ignored_columns == ()
