"""How often a residual learner is kept where there is nothing to learn, and where there is little.

    python -m tests.bench.gate [--first 0] [--seeds 20] [--rows 200]

Made-up residuals on poses of three joints; only the noise differs: `normal`; `heavy`, Student's t with 2.5 degrees of
freedom; `sessions`, normal in ten sessions with an offset of each; `uneven`, three times as large at one end of a
joint's range. `learnable` is a smooth curve whose RMS is so many times that of normal noise. Printed is how many seeds
keep a learner, by kind, and how often each passed its own test.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from calibration.numerics.single_thread import SingleThreaded, one_blas_thread
from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.selection import Selection, select_residual

NOISES = ("normal", "heavy", "sessions", "uneven")
SIGNALS = (0.25, 0.5, 1.0)


def trial(noise: str, signal: float, rows: int, seed: int) -> Selection:
    """The gate's decision on one data set."""
    rng = np.random.default_rng([seed, 77])
    joints = rng.uniform(-1.0, 1.0, (rows, 3))
    axes = np.broadcast_to(np.eye(3), (rows, 3, 3))
    seen = Features(("a_deg", "b_deg", "c_deg"), joints * 50.0, np.empty((rows, 0)), 100.0 * axes, axes)
    cells = np.array([f"{a:.0f},{b:.0f}" for a, b in np.round(joints[:, :2] * 5)])
    session = np.arange(rows) * 10 // rows
    error: Floats = rng.normal(0.0, 1.0, (rows, 3))
    if noise == "heavy":
        error = rng.standard_t(2.5, (rows, 3))
    elif noise == "sessions":
        error = error + rng.normal(0.0, 1.0, (10, 3))[session]
    elif noise == "uneven":
        error = error * (2.0 + joints[:, :1])
    curve = np.column_stack([np.sin(3 * joints[:, 0]), 2 * joints[:, 1] ** 2 - 0.7, np.cos(4 * joints[:, 2])])
    target = error + signal * curve / np.sqrt((curve**2).mean())
    groups = np.array([f"s{s}" for s in session]) if noise == "sessions" else cells
    with one_blas_thread(), ThreadPoolExecutor(2) as pool:
        return select_residual(
            seen,
            target,
            groups,
            cells,
            kind="default",
            seed=seed,
            executor=SingleThreaded(pool),
            progress=lambda share: None,
        )


def main() -> None:
    """Print a line for each kind of data."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rows", type=int, default=200)
    options = parser.parse_args()
    for noise, signal in [(noise, 0.0) for noise in NOISES] + [("normal", signal) for signal in SIGNALS]:
        kept: Counter[str] = Counter()
        passed: Counter[str] = Counter()
        least = []
        for seed in range(options.first, options.first + options.seeds):
            found = trial(noise, signal, options.rows, seed)
            kept[found.residual.kind if found.residual is not None else "none"] += 1
            passed.update(t.kind for t in found.trials if t.kept)
            least.append(min((t.p for t in found.trials), default=1.0))
        title = f"{noise} noise, nothing to learn" if signal == 0.0 else f"learnable {signal:g}"
        print(
            f"{title:32s} {options.seeds - kept['none']:3d} of {options.seeds} keep one: {dict(kept)}   passed: "
            f"{dict(passed)}   least p, median {np.median(least):.2g}, smallest {min(least):.2g}",
            flush=True,
        )


if __name__ == "__main__":
    main()
