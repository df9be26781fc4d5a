"""Compiles ahead what the first calibration on a computer would wait for: `python -m daemon.warm_up`.

numba compiles a function when it is first called, and keeps the result in the directory that `daemon.numba_cache`
chooses; all of rigcal's take some twenty seconds. So set-up and installation run a small calibration by each method
that has loops of its own, cut short as soon as each loop was called. It fits invented fixes and writes nothing but the
two caches. Whatever goes wrong is one sentence and no failure: the first calibration compiles what is missing.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, MutableMapping
from typing import TYPE_CHECKING

import numpy as np

from daemon.numba_cache import prepare
from daemon.rigs import RigSource, load_rig

if TYPE_CHECKING:
    from calibration.observations import Observations

_RIG = "swdt82"  # with couplings, rows of beta, prismatic joints and several prisms: all that a rig may have
_POSES = 30
_CURVES = 100  # columns that are nearly all zero, as splines are
_JOINT_ERROR_DEG = 0.15  # far beyond noise: a global search is asked for, yet no search for encoders that are reversed


def place_of_caches(environ: MutableMapping[str, str]) -> str | None:
    """Choose where the caches are, as `numba_cache.prepare`; call before numba or matplotlib is imported.

    Returns:
        A sentence where that is not where they were meant to be.

    Raises:
        OSError: not even a temporary directory can be made.
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
    """Call everything that is compiled, and index the fonts that reports are drawn with."""
    from matplotlib.font_manager import findfont

    from calibration.kernels.gram import gram
    from calibration.pipeline import calibrate
    from calibration.residual.forest import Forest

    findfont("DejaVu Sans")
    source = load_rig(_RIG)
    rig, text, observations = source.rig, source.text, _invented(source)
    calibrate(rig, text, observations, residual="none", should_stop=_after_one_round())
    # Effects that explain all would leave nothing to learn.
    calibrate(rig, text, observations, effects="none", should_stop=_after_one_round())
    calibrate(rig, text, observations, method="pde-paper", residual="none", should_stop=_after_one_round())
    gram(np.eye(_CURVES))  # so few fixes ask for no curves of many splines
    Forest.build([()]).predict(np.zeros((1, 1)), np.zeros(1, dtype=np.int64))  # nor for trees


def _invented(source: RigSource) -> Observations:
    """Fixes of all prisms in random poses of the nominal machine, whose joints err by more than its model can say."""
    from calibration.kinematics import Chain, ChainData, Placement
    from calibration.observations import Observations

    rng = np.random.default_rng(0)
    rig = source.rig
    chain = Chain(rig, {"": Placement(np.eye(3), np.array([0.0, 8000.0, 0.0]))})
    prism = np.tile(np.arange(len(rig.prisms)), _POSES)
    n = len(prism)
    readings = np.repeat(np.column_stack([rng.uniform(*j.limits, _POSES) for j in rig.joints]), len(rig.prisms), axis=0)
    true = readings + _JOINT_ERROR_DEG * np.sin(np.radians(5.0 * readings))
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


def _after_one_round() -> Callable[[], bool]:
    """What a search asks before every round: one is enough to have called everything."""
    return itertools.chain([False], itertools.repeat(True)).__next__


def main(environ: MutableMapping[str, str] = os.environ) -> int:
    """Entry of the process; exit status 0 whatever comes of it."""
    try:
        displaced = place_of_caches(environ)
        if displaced is not None:
            print(f"rigcal warm-up: {displaced}", file=sys.stderr)
        compile_ahead()
    except Exception as error:  # noqa: BLE001 - a set-up must not end for want of a head start
        print(
            f"rigcal warm-up: {type(error).__name__}: {error}; the first calibration compiles instead", file=sys.stderr
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
