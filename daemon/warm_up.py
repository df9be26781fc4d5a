"""Caches of compiled kernels: choosing their directory, and compiling ahead of time (`python -m daemon.warm_up`).

numba compiles a function at its first call; compiling all of rigcal's kernels takes about twenty seconds. numba and
matplotlib keep caches between runs, by default next to the installed program or in the home directory. A service cannot
write to either, and on a laptop they may be read-only; numba then refuses to compile at all. So `prepare` chooses a
writable directory before either package is imported.

Set-up and installation call `main`, which runs a small calibration with each method that has its own kernels and stops
once each kernel was called. It fits synthetic fixes and writes nothing but the two caches. A failure is reported in one
sentence, with exit status 0: the first calibration compiles what is missing.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import stat
import sys
import tempfile
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration.observations import Observations
    from calibration.rig.description import Rig
    from calibration.run_settings import Run

_RIG = "swdt82"  # has all that a rig may have: couplings, rows of beta, prismatic joints, several prisms
_POSES = 30
_CURVES = 100  # columns that are nearly all zero, as splines are
_JOINT_ERROR_DEG = 0.15  # far above noise: triggers the global search, but not the search for reversed encoders


def prepare(environ: MutableMapping[str, str] = os.environ) -> Path:
    """Point NUMBA_CACHE_DIR and MPLCONFIGDIR at writable directories; call before numba or matplotlib is imported.

    A directory that the user has set is kept if it is writable. Otherwise the service's CACHE_DIRECTORY (systemd), the
    user's cache directory and a private temporary directory are tried in this order.

    Args:
        environ: the process's environment, which spawned children inherit.

    Returns:
        The directory of the numba cache.

    Raises:
        OSError: not even a temporary directory can be created.
    """
    root: Path | None = None
    for variable, name in (("NUMBA_CACHE_DIR", "numba"), ("MPLCONFIGDIR", "matplotlib")):
        if environ.get(variable) and _writable(Path(environ[variable])):
            continue
        if root is None:
            root = next((path for path in _candidates(environ) if _writable(path)), None) or _private_temporary()
        path = root / name
        path.mkdir(exist_ok=True)
        environ[variable] = str(path)
    return Path(environ["NUMBA_CACHE_DIR"])


def is_compiled(environ: MutableMapping[str, str] = os.environ) -> bool:
    """Return True if the cache directory that `prepare` chooses already holds compiled code."""
    return any(prepare(environ).rglob("*.nbi"))


def _candidates(environ: MutableMapping[str, str]) -> Iterator[Path]:
    if service := environ.get("CACHE_DIRECTORY"):
        yield Path(service.split(":")[0])
    if cache := environ.get("XDG_CACHE_HOME"):
        yield Path(cache) / "rigcal"
    if home := environ.get("HOME"):
        yield Path(home) / ".cache" / "rigcal"


def _writable(path: Path) -> bool:
    # Permission bits do not reveal read-only mounts, so create a file.
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def _private_temporary() -> Path:
    # The caches hold code that is executed: do not use a directory that another user could have prepared.
    path = Path(tempfile.gettempdir()) / f"rigcal-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = path.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
        return path
    return Path(tempfile.mkdtemp(prefix="rigcal-"))


# ---- compiling ahead -------------------------------------------------------------------------------------------------


def place_of_caches(environ: MutableMapping[str, str]) -> str | None:
    """Choose the cache directories with `prepare`.

    Returns:
        A warning if the intended directory cannot be used, else None.

    Raises:
        OSError: not even a temporary directory can be created.
    """
    meant = environ.get("NUMBA_CACHE_DIR") or environ.get("CACHE_DIRECTORY", "").split(":")[0] or environ.get("HOME")
    directory = prepare(environ)
    if meant and directory.is_relative_to(meant):
        return None
    return (
        f"{meant or 'a home directory'} cannot be written, so compiled kernels are kept in {directory}; make it "
        "writable for the user that calibrates"
    )


def compile_ahead() -> None:
    """Call all compiled functions, and index the fonts that reports use."""
    import numpy as np
    from matplotlib.font_manager import findfont

    from calibration.numerics.matrices import gram
    from calibration.pipeline.calibrate import calibrate
    from calibration.residual.trees.forest import Forest
    from daemon.rig_files import load_rig

    findfont("DejaVu Sans")
    source = load_rig(_RIG)
    # Fixes that the kinematics explain need no long search for effects and leave no residual to learn.
    well, badly = ((source.rig, source.text, _invented(source.rig, error)) for error in (0.0, _JOINT_ERROR_DEG))
    calibrate(*well, residual="none", run=_one_round())
    calibrate(*badly, effects="none", run=_one_round())
    calibrate(*badly, method="pde-paper", residual="none", run=_one_round())
    gram(np.eye(_CURVES))  # with so few fixes the calibrations need no curves of many splines
    Forest.build([()]).predict(np.zeros((1, 1)), np.zeros(1, dtype=np.int64))  # and no trees


def _invented(rig: Rig, joint_error_deg: float) -> Observations:
    """Make synthetic fixes of all prisms in random poses, with joint errors that the kinematics cannot represent."""
    import numpy as np

    from calibration.kinematics.chain import Chain, ChainData, Placement
    from calibration.observations import Observations

    rng = np.random.default_rng(0)
    chain = Chain(rig, {"": Placement(np.eye(3), np.array([0.0, 8000.0, 0.0]))})
    prism = np.tile(np.arange(len(rig.prisms)), _POSES)
    n = len(prism)
    readings = np.repeat(np.column_stack([rng.uniform(*j.limits, _POSES) for j in rig.joints]), len(rig.prisms), axis=0)
    true = readings + joint_error_deg * np.sin(np.radians(5.0 * readings))
    position_mm = chain.positions_mm(np.zeros(len(chain)), ChainData(true, prism, np.zeros(n, dtype=np.intp)))
    nothing = np.full(n, "", dtype=np.str_)
    return Observations(
        np.array(rig.prism_names)[prism],
        dict(zip(rig.joint_names, readings.T, strict=True)),
        position_mm + rng.normal(0.0, 2.0, (n, 3)),
        np.full((n, 3), np.nan),
        nothing,
        nothing,
        np.repeat(np.arange(_POSES), len(rig.prisms)).astype(np.str_),
    )


def _one_round() -> Run:
    """Return run settings whose search stops after one round, which calls all kernels."""
    from calibration.run_settings import Run

    return Run(should_stop=itertools.chain([False], itertools.repeat(True)).__next__)


def main(environ: MutableMapping[str, str] = os.environ) -> int:
    """Compile ahead; the exit status is always 0."""
    try:
        displaced = place_of_caches(environ)
        if displaced is not None:
            print(f"rigcal warm-up: {displaced}", file=sys.stderr)
        compile_ahead()
    except Exception as error:  # noqa: BLE001 - set-up must not fail because compiling ahead did
        print(
            f"rigcal warm-up: {type(error).__name__}: {error}; the first calibration compiles instead", file=sys.stderr
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
