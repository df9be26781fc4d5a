"""Helpers of the calibration tests: shipped rig texts, measured data, one simulated session."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from calibration.kinematics.chain import Chain
from calibration.kinematics.compiled_chain import CompiledChain
from calibration.model.model import CalibratedModel
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.residual.features import Extractor, Features
from calibration.rig.description import Rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

DATA = Path(__file__).parent.parent / "data"


def rig_text(name: str) -> str:
    """TOML of a shipped rig."""
    return resources.files("calibration").joinpath("rigs", f"{name}.toml").read_text(encoding="utf-8")


def split_by_cells(observations: Observations, share: float, seed: int) -> tuple[Observations, Observations]:
    """Training and held-out rows: whole workspace cells, `share` of them for training."""
    cells = observations.cells()
    labels = np.unique(cells)
    np.random.default_rng(seed).shuffle(labels)
    training = np.isin(cells, labels[: int(share * len(labels))])
    return observations.select(training), observations.select(~training)


def simulated(truth: RigTruth, fixes: int, seed: int, setup: str = "", repeats: int = 1) -> Observations:
    """Fixes of the prisms in turn, 3 mm of noise on each coordinate."""
    data = simulate_observations(
        truth, fixes // repeats, seed, prisms_per_pose="one", noise_mm=3.0, setup=setup, repeats=repeats
    )
    return parse_observations(data.csv_text().encode(), truth.rig, "simulated.csv")


def features(chain: Chain, x: Floats, observations: Observations, signals: Sequence[str]) -> Features:
    """What a residual learner sees of observations: `Extractor` for kinematics without a model."""
    data = chain.bind(observations)
    return Extractor(chain, x, signals)(data.readings, CompiledChain(chain, x).linearise(data), observations.extra)


def rms(error_mm: np.ndarray) -> float:
    """RMS of the 3-D norm of (n, 3) errors."""
    return float(np.sqrt((error_mm**2).sum(axis=1).mean()))


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """As the pipeline has it; parts that are called directly would be slow beside their own worker threads."""
    with threadpool_limits(1, user_api="blas"):
        yield


@dataclass(frozen=True)
class Session:
    """A machine without hidden effects, 250 training and 500 held-out fixes, and its model."""

    rig: Rig
    truth: RigTruth
    training: Observations
    held_out: Observations
    model: CalibratedModel


@pytest.fixture(scope="session")
def session() -> Session:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 7)
    training, held_out = simulated(truth, 250, 7), simulated(truth, 500, 8)
    return Session(rig, truth, training, held_out, identify(rig, rig_text("swdt82"), training))


@pytest.fixture(scope="session")
def ur10_random_poses() -> Observations:
    """The measured UR10 data."""
    path = DATA / "ur10_random_poses.csv"
    return parse_observations(path.read_bytes(), shipped_rig("ur10"), path.name)
