"""dh.csv: the identified constants as a Denavit-Hartenberg table, mm and deg, which `rigcal rig import` can read."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

from calibration.export.model_export import kinematics_format, shortest
from calibration.kinematics.chain import ROW_ORDER, Chain
from calibration.observations import Floats
from calibration.rig.exchange.from_table import BEFORE, CONSTANTS, DRIVES, JOINT, PRISM


def dh_text(chain: Chain, x: Floats, remarks: Sequence[str]) -> str:
    """Return a rig with parameters `x` (p,) as a table, mm and deg, with remarks as comments at its head.

    The table has a line for each joint, for each row of the kinematic table in the rig file's convention, and for each
    prism.
    """
    rig, out = chain.rig, io.StringIO()
    names = [name for name, _ in ROW_ORDER[rig.convention]]
    header = [
        "after", *BEFORE, *(f"{name}_{CONSTANTS[name]}" for name in names), *(f"{name}_drive" for name in DRIVES),
        "identify", *JOINT, *PRISM,
    ]  # fmt: skip
    out.writelines(f"# {line}\n" for remark in remarks for line in remark.split("\n"))
    out.write(f"# convention: {rig.convention}\n")
    writer = csv.DictWriter(out, header, lineterminator="\n")
    writer.writeheader()
    for joint in rig.joints:
        limits = (shortest(value) for value in (*joint.limits, joint.max_rate))
        writer.writerow(dict(zip(JOINT, (joint.name, joint.kind, *limits), strict=True)))
    corrections = {parameter.name: float(value) for parameter, value in zip(chain.parameters, x, strict=True)}
    for number, row in enumerate(rig.rows, 1):
        cells: dict[str, object] = {"after": (0, *rig.path(number))[-2]}
        if row.before is not None:
            cells |= {key: shortest(value) for key, value in row.before.model_dump().items()}
        for name in names:
            column, correction = f"{name}_{CONSTANTS[name]}", corrections.get(f"row{number}.{name}", 0.0)
            unit = math.degrees(1.0) if CONSTANTS[name] == "deg" else 1.0
            cells[column] = shortest(getattr(row, column) + correction * unit)
        for driven, terms in row.drive.items():
            cells[f"{driven}_drive"] = " ".join(
                f"{'-' if c < 0.0 else '+'} {shortest(abs(c))}*{name}" for name, c in terms.items()
            ).removeprefix("+ ")
        cells["identify"] = " ".join(row.identify) or "-"
        writer.writerow(cells)
    for prism, offsets in zip(rig.prisms, chain.prism_ops, strict=True):
        place = [op.constant + (float(x[op.parameter]) if op.parameter >= 0 else 0.0) for op in offsets]
        named = dict(zip(PRISM, (prism.name, prism.frame, *map(shortest, place)), strict=True))
        writer.writerow(named)
    return out.getvalue()


FORMAT = kinematics_format("dh-csv", "dh.csv", "the identified Denavit-Hartenberg constants", dh_text)
