"""A small calibrated model of measured data, made once."""

from __future__ import annotations

import functools
from pathlib import Path

from calibration.evaluation.evaluation import Evaluation
from calibration.model.model import CalibratedModel
from calibration.observations import parse_observations
from calibration.pipeline.calibrate import calibrate
from daemon.rig_files import load_rig

UR10_CSV = Path(__file__).parents[2] / "data" / "ur10_random_poses.csv"
TRAIN_ROWS, TEST_ROWS = 240, 60


def csv_rows(start: int, stop: int) -> bytes:
    """Rows of the measured data under their header, taken from all over the file."""
    header, *rows = UR10_CSV.read_bytes().splitlines(keepends=True)
    return header + b"".join(rows[:: len(rows) // (TRAIN_ROWS + TEST_ROWS)][start:stop])


def train_csv() -> bytes:
    return csv_rows(0, TRAIN_ROWS)


def held_out_csv() -> bytes:
    return csv_rows(TRAIN_ROWS, TRAIN_ROWS + TEST_ROWS)


@functools.cache
def small_calibration() -> tuple[CalibratedModel, Evaluation]:
    """A ur10 model with a LightGBM residual, and its errors on its training rows.

    Without effects: with them so few rows leave nothing to learn, and the residual counts nowhere.
    """
    source = load_rig("ur10")
    observations = parse_observations(train_csv(), source.rig, "train.csv")
    model, evaluation = calibrate(source.rig, source.text, observations, effects="none", residual="lightgbm")
    assert model.residual is not None
    return model, evaluation
