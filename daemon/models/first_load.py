"""The first load of a model, in a child process that may crash; `model_files` starts it and checks its exit status.

Standard input carries the files: a line of JSON with their names and sizes, then their bytes. Exit status 0: the model
loads and predicts. IS_NO_MODEL: it does not. CANNOT: this computer cannot find out (a system library is missing). The
last line on standard error is the reason. Death by a signal: the parser crashed.

The process may use MEMORY_MAX_BYTES more than the program itself; a model that needs more is refused with an error.
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calibration.errors import CalibrationError, ModelError
from calibration.numerics.stored_arrays import LARGEST
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig
from daemon.warm_up import prepare

IS_NO_MODEL = 3
CANNOT = 4
MEMORY_MAX_BYTES = 400 << 20


def encode(files: Mapping[str, bytes]) -> bytes:
    """Encode files, name -> content, in the format that `main` reads."""
    sizes = {name: len(data) for name, data in files.items()}
    return b"".join((json.dumps(sizes).encode("ascii"), b"\n", *files.values()))


def main() -> int:
    """Load the model from standard input and predict with it; return the exit status."""
    sizes = json.loads(sys.stdin.buffer.readline())
    files = {name: sys.stdin.buffer.read(size) for name, size in sizes.items()}
    prepare()
    # Imported before the limit is set, so that they count as the program's own memory.
    import calibration.model.files
    import calibration.model.prediction  # noqa: F401

    limit_memory(MEMORY_MAX_BYTES)
    try:
        smoke_test(files)
    except MemoryError:
        print(f"the model needs more than {MEMORY_MAX_BYTES >> 20} MiB of memory; restore it", file=sys.stderr)
        return IS_NO_MODEL
    except CalibrationError as error:
        print(error, file=sys.stderr)
        return IS_NO_MODEL if isinstance(error, ModelError) else CANNOT
    return 0


def limit_memory(more_bytes: int) -> None:
    """Limit how many more bytes this process may allocate from now on; beyond the limit a MemoryError is raised.

    Without /proc the memory in use is unknown, and no limit is set.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return
    taken_kib = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmData:"))
    resource.setrlimit(resource.RLIMIT_DATA, ((taken_kib << 10) + more_bytes,) * 2)


def smoke_test(files: Mapping[str, bytes]) -> None:
    """Load a model, and predict every prism at every set-up, in the middle of the joints' limits and where trained.

    Args:
        files: name -> content.

    Raises:
        ModelError: the files are not a model, or the model cannot predict.
        CalibrationError: this computer lacks something that loading needs.
    """
    from calibration.model.files import model_from_files
    from calibration.model.prediction import Predictor

    model = model_from_files(files)
    poses = np.array([[sum(joint.limits) / 2 for joint in model.rig.joints]])
    if model.residual is not None:
        poses = np.concatenate([poses, model.residual.region.poses])
    for setup in model.placements:
        try:
            predicted = Predictor.of(model).predict(_rows(model.rig, poses, setup))
        except (CalibrationError, ArithmeticError, LookupError, TypeError, ValueError) as error:
            # Infinite numbers or inconsistent parts: the fault is the model's, as predicting depends on no system part.
            reason = " ".join(str(error).split())
            raise ModelError(f"the model cannot predict ({reason}); restore it or calibrate again") from error
        if not max(np.abs(predicted.position_mm).max(), predicted.sigma_mm.max()) <= LARGEST:
            raise ModelError(
                f"the model predicts positions or sigmas beyond {LARGEST:.0e} mm; restore it or calibrate again"
            )


def _rows(rig: Rig, poses: Floats, setup: str) -> Observations:
    """Return rows of every prism at every pose, at one set-up."""
    n = len(poses) * len(rig.prism_names)
    return Observations(
        prism=np.repeat(np.array(rig.prism_names), len(poses)),
        joints={
            joint.name: np.tile(readings, len(rig.prism_names))
            for joint, readings in zip(rig.joints, poses.T, strict=True)
        },
        position_mm=np.full((n, 3), np.nan),
        sigma_mm=np.full((n, 3), np.nan),
        setup=np.full(n, setup),
        session=np.full(n, ""),
        pose=np.full(n, ""),
    )


if __name__ == "__main__":
    sys.exit(main())
