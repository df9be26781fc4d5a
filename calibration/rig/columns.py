"""Columns of an observations table: their names, units and meanings.

`calibration.table` reads these columns, and docs/reference/rig-keys.md lists them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LEAST_SIGMA_MM = 1e-6  # 1 nm: no instrument has a smaller standard deviation
JOINT, SIGNAL = "<joint>", "<signal>"
_ALWAYS = "required"
_MEASURED = "required, except for `rigcal predict`"


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        name: name as in the header; `<joint>` and `<signal>` stand for names of the rig file.
        unit: unit of the numbers; "" for labels and numbers without a unit.
        meaning: meaning of the values.
        need: whether a table must have the column.
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
    Column("setup", "", "name of the station set-up; each set-up has its own base transform"),
    Column("session", "", "name of the calibration session"),
    Column("pose", "", "name of the standstill; all fixes of one standstill have the same"),
)
SIGMA = tuple(
    Column(
        f"sigma_{axis}_mm",
        "mm",
        f"standard deviation of `{axis}_mm`, {LEAST_SIGMA_MM:g} or more; give all three or none",
    )
    for axis in "xyz"
)
OF_JOINT = (
    Column(f"{JOINT}_dir", "", "last direction of motion: -1, 0 or 1"),
    Column(f"{JOINT}_rate", "deg/s or mm/s", "speed at the instant of the fix"),
    Column(f"{JOINT}_Nm", "Nm", "measured torque, which replaces the computed one"),
)
CONDITIONS = (
    Column("time_s", "s", "instant of the fix, from any origin"),
    Column("dwell_s", "s", "time since the last motion"),
    Column("temperature_degC", "degC", "temperature of the machine"),
    Column("payload_kg", "kg", "mass of the payload"),
)
SIGNALS = (
    Column(f"{SIGNAL}_bar", "bar", "a pressure; with a joint's name, the pressure in that joint's cylinder"),
    Column(f"{SIGNAL}_mA", "mA", "a current"),
    Column(f"{SIGNAL}_<unit>", "any", "any other number that the rig file or `--signal` names"),
)
PREDICTED = (
    *(Column(f"{axis}_pred_mm", "mm", f"predicted `{axis}_mm`") for axis in "xyz"),
    *(
        Column(
            f"sigma_{axis}_pred_mm",
            "mm",
            f"standard deviation of a fix about `{axis}_pred_mm`; `half90_{axis}_pred_mm` is 1.645 times this",
        )
        for axis in "xyz"
    ),
)
INTERVALS = (
    *(
        Column(
            f"half90_{axis}_pred_mm", "mm", f"a fix is within this distance of `{axis}_pred_mm` with 90 % probability"
        )
        for axis in "xyz"
    ),
    Column("radius90_pred_mm", "mm", "a fix is within this 3-D distance of the prediction with 90 % probability"),
)
CLOSURE = Column("closure_mm", "mm", "distance between prism and target that the model predicts with the row's joints")
FIXES = Column("fixes", "", "number of fixes of each prism to take at a pose of a plan")
READ = (PRISM, *READINGS, *POSITION, *LABELS, *SIGMA, *OF_JOINT, *CONDITIONS, *SIGNALS)
WRITTEN = (*PREDICTED, *INTERVALS, CLOSURE, FIXES)


def names(columns: Iterable[Column]) -> tuple[str, ...]:
    """Return the names of columns."""
    return tuple(column.name for column in columns)


def names_of_joint(columns: Iterable[Column], joint: str) -> tuple[str, ...]:
    """Return the names of columns with `<joint>` replaced by the name of a joint."""
    return tuple(name.replace(JOINT, joint) for name in names(columns))


def own_columns(joint_names: Iterable[str]) -> frozenset[str]:
    """Return the names of all columns that are defined without a `[[signal]]`, except pressures and currents."""
    of_joints = (name for joint in joint_names for name in names_of_joint((*READINGS, *OF_JOINT), joint))
    return frozenset((*names((PRISM, *POSITION, *LABELS, *SIGMA, *CONDITIONS, *WRITTEN)), *of_joints))
