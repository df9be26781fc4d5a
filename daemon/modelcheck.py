"""The first load of a model, in a process that may die of it: `daemon.modelfiles` runs this and looks at how it ends.

Standard input carries the files, one JSON object of base64 texts. Exit status 0: the model loads and predicts;
IS_NO_MODEL: it does not; CANNOT: this machine cannot tell (a system library is missing); the last line on standard
error says why. A signal: the parser brought the process down.
"""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Mapping

import numpy as np

from calibration.errors import CalibrationError, ModelError
from calibration.model_checks import LARGEST
from calibration.observations import Observations
from daemon.numba_cache import prepare

IS_NO_MODEL = 3
CANNOT = 4


def encode(files: Mapping[str, bytes]) -> bytes:
    """Files as `main` reads them."""
    return json.dumps({name: base64.b64encode(data).decode("ascii") for name, data in files.items()}).encode("ascii")


def main() -> int:
    """Load the model on standard input and predict with it."""
    files = {name: base64.b64decode(text) for name, text in json.load(sys.stdin.buffer).items()}
    prepare()
    try:
        _smoke_test(files)
    except CalibrationError as error:
        print(error, file=sys.stderr)
        return IS_NO_MODEL if isinstance(error, ModelError) else CANNOT
    return 0


def _smoke_test(files: Mapping[str, bytes]) -> None:
    """Every prism at every set-up, at the middle of the joints' limits and where the residual was trained."""
    from calibration.model import CalibratedModel

    model = CalibratedModel.from_files(files)
    prisms, setups = model.rig.prism_names, tuple(model.placements)
    poses = np.array([[sum(joint.limits) / 2 for joint in model.rig.joints]])
    if model.residual is not None:
        poses = np.concatenate([poses, model.residual.region.poses])
    n = len(poses) * len(prisms) * len(setups)
    rows = Observations(
        prism=np.tile(np.repeat(np.array(prisms), len(poses)), len(setups)),
        joints={
            joint.name: np.tile(readings, len(prisms) * len(setups))
            for joint, readings in zip(model.rig.joints, poses.T, strict=True)
        },
        position_mm=np.full((n, 3), np.nan),
        sigma_mm=np.full((n, 3), np.nan),
        setup=np.repeat(np.array(setups), len(poses) * len(prisms)),
        session=np.full(n, ""),
        pose=np.full(n, ""),
    )
    try:
        predicted = model.predict(rows)
    except (CalibrationError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        # Infinite numbers, or parts that do not fit each other; predicting needs nothing of this machine.
        reason = " ".join(str(error).split())
        raise ModelError(f"the model cannot predict ({reason}); restore it or calibrate again") from error
    if max(np.abs(predicted.position_mm).max(), predicted.sigma_mm.max()) > LARGEST:
        raise ModelError(
            f"the model predicts positions or deviations beyond {LARGEST:.0e} mm; restore it or calibrate again"
        )


if __name__ == "__main__":
    sys.exit(main())
