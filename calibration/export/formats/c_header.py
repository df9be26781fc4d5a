"""rigcal_model.h: forward kinematics with effects, and the inverse, as C99 for a controller.

The code needs only the standard library. The learned residual is left out
(docs/decisions/0032-models-for-other-tools.md).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from importlib import resources

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.export.c_effects import EffectCode, EffectWriter
from calibration.export.correction_grid import Machine
from calibration.export.model_export import Export, Format, LeftOut
from calibration.export.motions import Carriers, carriers, motion_tree
from calibration.kinematics.torques import GravityModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats
from calibration.rig.description import Rig

_ENGINE = "engine.h"
_SLOT = "/*EFFECTS*/"
_USE = """\
   Call rigcal_forward(q, in, places) for the positions of the prisms in the base frame, mm, at the joint readings q,
   and rigcal_inverse(count, prism, target, in, q) for the commands that bring prisms to targets. The code is C99. It
   allocates no memory and keeps no state between calls, so any number of threads may call it.
   Joints, in the order of q:
"""


def _with_effects(engine: str, code: EffectCode) -> str:
    lines = [f"    {line}" for line in code.lines]
    if code.needs_pose:
        lines = [
            "    rigcal_pose(q, NULL, at);",
            "    for (int p = 0; p < points->count; p++) {",
            "        const int prism = points->prism[p];",
            "        rigcal_place(at, rigcal_prism_motion[prism], rigcal_prism_place[prism], points->place[p]);",
            "    }",
            *lines,
            "    return 1;",
        ]
    else:
        lines += ["    (void)at;", "    return 0;"]
    return engine.replace(_SLOT, "\n".join(lines))


def _inputs(code: EffectCode) -> str:
    fields = {
        "direction": "    double direction[RIGCAL_JOINTS]; /* last direction of motion: -1, 1, or 0 if not known */\n",
        "temperature_degC": "    double temperature_degC;          /* of the machine; NAN if not known */\n",
    }
    used = "".join(text for name, text in fields.items() if name in code.inputs)
    nothing = "    int unused; /* this model needs only the joint readings */\n"
    return f"typedef struct {{\n{used or nothing}}} rigcal_inputs;\n\n"


def _sizes(rig: Rig, tree: Carriers) -> str:
    sizes = {"JOINTS": len(rig.joints), "PRISMS": len(rig.prisms), "MOTIONS": len(tree.motions)}
    sizes["FRAMES"] = len(tree.frames)
    return "".join(f"#define RIGCAL_{name} {number}\n" for name, number in sizes.items()) + "\n"


def _tables(rig: Rig, tree: Carriers, down: Floats, code: EffectCode) -> Iterable[str]:
    motions, prisms = tree.motions, list(tree.prisms.values())
    drives = [drive for motion in motions for drive in motion.drive]
    kinds = [1 if motion.rotates else 2 for motion in motions]
    first = [0, *itertools.accumulate(len(motion.drive) for motion in motions)]
    unit = [np.degrees(1.0) / 1e3 if joint.kind == "revolute" else 1.0 for joint in rig.joints]
    low, high = zip(*(joint.limits for joint in rig.joints), strict=True)
    yield from (
        _table("int", "parent", "RIGCAL_MOTIONS", (motion.parent for motion in motions)),
        _table("int", "kind", "RIGCAL_MOTIONS", kinds),
        _table("int", "axis", "RIGCAL_MOTIONS", (motion.axis for motion in motions)),
        _table("int", "first_drive", "RIGCAL_MOTIONS + 1", first),
        _table("int", "drive_joint", str(len(drives)), (joint for joint, _ in drives)),
        _table("double", "drive_size", str(len(drives)), (size for _, size in drives)),
        _rows("fixed", "RIGCAL_MOTIONS][12", [motion.fixed[:3].reshape(-1) for motion in motions]),
        _rows("beyond", "RIGCAL_MOTIONS][RIGCAL_MOTIONS", [tree.beyond(k) for k in range(len(motions))], kind="int"),
        _table("int", "frame_motion", "RIGCAL_FRAMES", (motion for motion, _ in tree.frames)),
        _rows("frame_origin", "RIGCAL_FRAMES][3", [place[:3, 3] for _, place in tree.frames]),
        _rows("holds", "RIGCAL_FRAMES][RIGCAL_PRISMS", _holds(rig), kind="int"),
        _table("int", "prism_motion", "RIGCAL_PRISMS", (motion for motion, _ in prisms)),
        _rows("prism_place", "RIGCAL_PRISMS][3", [place for _, place in prisms]),
        _rows("prism_mount", "RIGCAL_PRISMS][3", [tree.frames[prism.frame][1][:3, 3] for prism in rig.prisms]),
        _table("double", "lower", "RIGCAL_JOINTS", low),
        _table("double", "upper", "RIGCAL_JOINTS", high),
        _table("double", "load_unit", "RIGCAL_JOINTS", unit),
        _table("double", "down", "3", down.tolist()),
        *code.tables,
    )


def _holds(rig: Rig) -> list[list[bool]]:
    """Return for each frame and prism whether the frame carries the prism."""
    paths = [(0, *rig.path(prism.frame)) for prism in rig.prisms]
    return [[frame in path for path in paths] for frame in range(len(rig.rows) + 1)]


def _table(kind: str, name: str, size: str, values: Iterable[float]) -> str:
    return f"static const {kind} rigcal_{name}[{size}] = {{{_numbers(kind, values)}}};"


def _rows(name: str, size: str, rows: Sequence[Iterable[float]], kind: str = "double") -> str:
    lines = ",\n    ".join("{" + _numbers(kind, row) + "}" for row in rows)
    return f"static const {kind} rigcal_{name}[{size}] = {{\n    {lines}}};"


def _numbers(kind: str, values: Iterable[float]) -> str:
    return ", ".join(repr(int(v) if kind == "int" else float(v)) for v in values)


def _context(export: Export) -> EffectContext:
    """Return the context of effects at one pose of the machine; the shapes of uncertain loads do not depend on it."""
    model = export.model
    rows = Machine(model, export.setup).rows(model.rig.prism_names[0], np.zeros((1, len(model.rig.joints))))
    return Predictor.of(model).context(rows)


def _writer(export: Export) -> EffectWriter:
    return EffectWriter(_context(export), carriers(motion_tree(export.model.chain, export.model.values)))


def written_effects(export: Export) -> tuple[FittedEffect, ...]:
    """Return the effects of a model that the header contains."""
    writer = _writer(export)
    moving = [effect for effect in export.model.effects if library()[effect.family].moves_machine]
    return tuple(effect for effect in moving if writer.can_write(effect))


def _left_out(export: Export) -> LeftOut:
    kept = written_effects(export)
    return export.without(lambda effect: effect in kept)


def _content(export: Export) -> bytes:
    """Return the header: comment, sizes, inputs of the caller, tables, and the functions with the effects."""
    writer = _writer(export)
    rig, tree = writer.context.rig, writer.tree
    down = GravityModel(export.model.chain, export.model.values).down[export.setup]
    code = writer.code(dict(enumerate(written_effects(export), 1)))
    remarks = export.heading(_left_out(export))
    engine = resources.files("calibration.export").joinpath(_ENGINE).read_text(encoding="utf-8")
    joints = "".join(
        f"     {i}  {j.name}, {j.unit}, {j.limits[0]:g} .. {j.limits[1]:g}\n" for i, j in enumerate(rig.joints)
    )
    prisms = "".join(f"     {i}  {name}\n" for i, name in enumerate(rig.prism_names))
    told = "\n   ".join(line for remark in remarks for line in remark.split("\n")).replace("*/", "* /")
    head = (
        f"/* {told}\n\n{_USE}{joints}   Prisms, in the order of the positions:\n{prisms}*/\n\n"
        "#ifndef RIGCAL_MODEL_H\n#define RIGCAL_MODEL_H\n\n#include <math.h>\n#include <stddef.h>\n\n"
    )
    return (
        head
        + _sizes(rig, tree)
        + _inputs(code)
        + "\n".join(_tables(rig, tree, down, code))
        + "\n\n"
        + _with_effects(engine, code)
    ).encode()


FORMAT = Format(
    "c-header",
    "rigcal_model.h",
    "forward kinematics with effects, and the inverse, as one C99 file",
    _content,
    _left_out,
)
