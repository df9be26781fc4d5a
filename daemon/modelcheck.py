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
from calibration.observations import Observations
from daemon.numba_cache import prepare

IS_NO_MODEL = 3
CANNOT = 4


def encode(files: Mapping[str, bytes]) -> bytes:
    """Files as `main` reads them."""
    return json.dumps({name: base64.b64encode(data).decode("ascii") for name, data in files.items()}).encode("ascii")


def main() -> int:
    """Load the model on standard input and predict with it at the middle of every joint's range."""
    files = {name: base64.b64decode(text) for name, text in json.load(sys.stdin.buffer).items()}
    prepare()
    try:
        _smoke_test(files)
    except CalibrationError as error:
        print(error, file=sys.stderr)
        return IS_NO_MODEL if isinstance(error, ModelError) else CANNOT
    return 0


def _smoke_test(files: Mapping[str, bytes]) -> None:
    from calibration.model import CalibratedModel

    model = CalibratedModel.from_files(files)
    n = len(model.rig.prism_names)
    middle = Observations(
        prism=np.array(model.rig.prism_names),
        joints={joint.name: np.full(n, sum(joint.limits) / 2) for joint in model.rig.joints},
        position_mm=np.full((n, 3), np.nan),
        sigma_mm=np.full((n, 3), np.nan),
        setup=np.full(n, next(iter(model.placements))),
        session=np.full(n, ""),
        pose=np.full(n, ""),
    )
    if not np.isfinite(model.predict(middle).position_mm).all():
        raise ModelError("the model predicts no finite position; restore it or calibrate again")


if __name__ == "__main__":
    sys.exit(main())
