"""Columns of an observations table: their names, units and meanings.

`calibration.table` reads by them, and docs/reference/rig-keys.md lists them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LEAST_SIGMA_MM = 1e-6  # 1 nm: of no instrument's fix is the standard deviation smaller
JOINT, SIGNAL = "<joint>", "<signal>"
_ALWAYS = "required"
_MEASURED = "required, but for `rigcal predict`"


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        name: as in the header; `<joint>` and `<signal>` stand for names of the rig file.
        unit: of its numbers; "" where they have none, and for labels.
        meaning: what it tells of the row.
        need: whether a table must have it.
    """

    name: str
    unit: str
    meaning: str
    need: str = "optional"


PRISM = Column("prism", "", "name of the prism, as in the rig file", _ALWAYS)
READINGS = (
    Column(f"{JOINT}_deg", "deg", "reading of a revolute joint at the instant of the fix", _ALWAYS),
    Column(f"{JOINT}_mm", "mm", "reading of a prismatic joint at the instant of the fix", _ALWAYS),
)
POSITION = (
    Column("x_mm", "mm", "east, in the frame of the levelled station", _MEASURED),
    Column("y_mm", "mm", "north", _MEASURED),
    Column("z_mm", "mm", "up", _MEASURED),
)
LABELS = (
    Column("setup", "", "name of the station set-up; each has a base transform of its own"),
    Column("session", "", "name of the calibration session"),
    Column("pose", "", "fixes of one standstill share it"),
)
SIGMA = tuple(
    Column(
        f"sigma_{axis}_mm",
        "mm",
        f"standard deviation of `{axis}_mm`, {LEAST_SIGMA_MM:g} or more; a fix has all three or none",
    )
    for axis in "xyz"
)
OF_JOINT = (
    Column(f"{JOINT}_dir", "", "last direction of motion: -1, 0 or 1"),
    Column(f"{JOINT}_rate", "deg/s or mm/s", "speed at the instant of the fix"),
    Column(f"{JOINT}_Nm", "Nm", "measured torque, in place of the computed one"),
)
CONDITIONS = (
    Column("time_s", "s", "instant of the fix, from any origin"),
    Column("dwell_s", "s", "time since the last motion"),
    Column("temperature_degC", "degC", "temperature of the machine"),
    Column("payload_kg", "kg", "mass that is carried"),
)
SIGNALS = (
    Column(f"{SIGNAL}_bar", "bar", "a pressure; of the cylinder that a joint is named after: its pressure"),
    Column(f"{SIGNAL}_mA", "mA", "a current"),
    Column(f"{SIGNAL}_<unit>", "its own", "any other number, where the rig file or `--signal` names it"),
)
PREDICTED = (
    *(Column(f"{axis}_pred_mm", "mm", f"predicted `{axis}_mm`") for axis in "xyz"),
    *(
        Column(
            f"sigma_{axis}_pred_mm",
            "mm",
            f"standard deviation of a fix about `{axis}_pred_mm`; 1.645 times it is `half90_{axis}_pred_mm`",
        )
        for axis in "xyz"
    ),
)
INTERVALS = (
    *(
        Column(f"half90_{axis}_pred_mm", "mm", f"a fix is that near to `{axis}_pred_mm` with 90 % probability")
        for axis in "xyz"
    ),
    Column("radius90_pred_mm", "mm", "a fix is that near to all three together with 90 % probability"),
)
CLOSURE = Column("closure_mm", "mm", "how far the model has the prism from its target, by the joints of the row")
FIXES = Column("fixes", "", "how many fixes of each prism to take at a pose of a plan")
READ = (PRISM, *READINGS, *POSITION, *LABELS, *SIGMA, *OF_JOINT, *CONDITIONS, *SIGNALS)
WRITTEN = (*PREDICTED, *INTERVALS, CLOSURE, FIXES)


def names(columns: Iterable[Column]) -> tuple[str, ...]:
    """Return the names of columns."""
    return tuple(column.name for column in columns)


def names_of_joint(columns: Iterable[Column], joint: str) -> tuple[str, ...]:
    """Return the names that columns have for a joint."""
    return tuple(name.replace(JOINT, joint) for name in names(columns))


def own_columns(joint_names: Iterable[str]) -> frozenset[str]:
    """Return the names of all columns that mean something without a `[[signal]]`, but pressures and currents."""
    of_joints = (name for joint in joint_names for name in names_of_joint((*READINGS, *OF_JOINT), joint))
    return frozenset((*names((PRISM, *POSITION, *LABELS, *SIGMA, *CONDITIONS, *WRITTEN)), *of_joints))
