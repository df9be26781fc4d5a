"""model.mat: the identified kinematics as arrays for MATLAB, Octave and scipy.io.loadmat; lengths mm, angles rad."""

from __future__ import annotations

import io
from typing import Any, cast

import numpy as np
from scipy.io import savemat

from calibration.export.correction_grid import Machine, trained_ranges
from calibration.export.model_export import Export, Format, without_parts
from calibration.export.motions import motion_tree

_CHECKS = 20
_USE = """\
T{k} = T{parent(k)} * fixed(:,:,k) * motion(k), T{0} = eye(4), counted from 1. motion(k) rotates about (kind 1) or
slides along (kind 2) axis(k) (1 x, 2 y, 3 z) by drive(k,:) * q, in rad or mm, where q are the readings in deg and mm;
kind 0 is no motion. The position of prism p is T{prism_motion(p)} * [prism_place(p,:) 1]'. check_prisms has the
positions at check_q.
"""


def _content(export: Export) -> bytes:
    model = export.model
    rig, tree = model.rig, motion_tree(model.chain, model.values)
    drive = np.zeros((len(tree.motions), len(rig.joints)))
    for index, motion in enumerate(tree.motions):
        for joint, size in motion.drive:
            drive[index, joint] += size
    low, high = trained_ranges(model)
    poses = np.random.default_rng(0).uniform(low, high, (_CHECKS, len(low)))
    kinematics = Machine(without_parts(model, ()), export.setup)
    prisms = list(tree.prisms.items())
    arrays = {
        "about": "\n".join((*export.heading(export.kinematics_alone), _USE)),
        "rig": rig.name,
        "joints": np.array(rig.joint_names, dtype=object),
        "units": np.array([joint.unit for joint in rig.joints], dtype=object),
        "limits": np.array([joint.limits for joint in rig.joints]),
        "parent": np.array([[motion.parent + 1] for motion in tree.motions], dtype=np.int32),
        "fixed": np.stack([motion.fixed for motion in tree.motions], axis=2),
        "kind": np.array([[0 if not m.drive else 1 if m.rotates else 2] for m in tree.motions], dtype=np.int32),
        "axis": np.array([[motion.axis + 1] for motion in tree.motions], dtype=np.int32),
        "drive": drive,
        "prisms": np.array([name for name, _ in prisms], dtype=object),
        "prism_motion": np.array([[tree.frames[frame] + 1] for _, (frame, _) in prisms], dtype=np.int32),
        "prism_place": np.array([place for _, (_, place) in prisms]),
        "parameters": np.array([p.name for p in model.parameters], dtype=object),
        "corrections": np.array([[p.value] for p in model.parameters]),
        "standard_errors": np.array([[p.standard_error] for p in model.parameters]),
        "check_q": poses,
        "check_prisms": np.stack([kinematics.corrected_mm(name, poses) for name, _ in prisms], axis=2),
    }
    out = io.BytesIO()
    savemat(cast("Any", out), arrays, do_compression=True)  # accepts file objects, unlike its stubs
    return out.getvalue()


FORMAT = Format(
    "matlab", "model.mat", "the identified kinematics as a .mat file", _content, lambda export: export.kinematics_alone
)
