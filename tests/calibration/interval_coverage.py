"""How often 95 % intervals cover the truth, on simulated machines without hidden effects.

    python -m tests.calibration.interval_coverage [--rig swdt82] [--sessions 300] [--first 1000] [--noise-mm 3]

Each session of each setting is its own machine: what the fit may correct is drawn from the prior that it assumes, times
`BUILT` for the prior mode that estimates its scale; all else is as the rig file says. Covered must be what the data see
and what they do not, each parameter by itself; predictions are compared with where the true machine has the prism for
the joints as read, measured fixes with the whole sigma. The intervals in brackets are Wilson's, for independent cases.
Those of one session are not (redundant parameters err together), so the standard error over sessions stands beside:
what the data do not see errs by what one machine was drawn, and a hundred machines tell the coverage of a kind of
parameter to 2.5 % only.

The base's angles of ys100 as built fall short, 93.0 +- 1.3 % over 300 sessions from 3000: its heading and the zero of
joint 1 are one unknown, of 5 degrees. On the way along it the two tilts of the station's frame go on a curve, which the
linear model's intervals leave. With the prior's scale known it is 92.6 %, one build tolerance off 93.9 %, and as turns
about the base's own axes the same fits hold 95.3 %. Predictions do not suffer, and no output has an interval of a base.
"""

from __future__ import annotations

import argparse
import itertools
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from calibration.identification.noise import reading_covariance, station_covariance
from calibration.identification.refinement import Prior, refine
from calibration.identification.solve import place
from calibration.kinematics.chain import Chain
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Rig, Row, shipped_rig
from simulators.rig.dataset import SimulatedObservations
from simulators.rig.screws import nominal_constants
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

FIXES, HELD_OUT = 250, 200
BUILT = 10.0  # build tolerances that a machine is off where the fit does not trust them
OUTLIERS = 0.05
LEVEL = 1.959964
PrismsPerPose = Literal["one", "all"]


@dataclass(frozen=True)
class Setting:
    """What a session is like."""

    rig: str = "swdt82"
    prisms_per_pose: PrismsPerPose = "one"
    prior: Prior = "recalibration"
    outliers: float = 0.0
    noise_mm: float | None = None  # the rig's own station where absent


@dataclass(frozen=True)
class Errors:
    """Errors over their standard deviations.

    Attributes:
        parameter: (p,) of every parameter.
        kind: (p,) `row mm`, `row rad`, `prism mm`, ...
        seen: (p,) whether the data shrank its prior to less than half.
        prediction: (rows, 3) of predicted positions, by the parameters alone.
        fix: (rows, 3) of measured positions, by everything.
    """

    parameter: Floats
    kind: NDArray[np.str_]
    seen: NDArray[np.bool_]
    prediction: Floats
    fix: Floats


def machine(rig: Rig, seed: int, tolerances: float) -> RigTruth:
    """A machine that deviates so many build tolerances in what `rig` identifies, and in nothing else.

    It is the nominal machine of a rig file with other numbers; a prism whose mounting is unknown is drawn in any case.
    """
    body = Chain(rig, {})
    rng = np.random.default_rng([seed, 21])
    sigma = np.where(np.isinf(body.prior_sigma), 0.0, body.prior_sigma * tolerances)
    off = dict(zip((p.name for p in body.parameters), sigma * rng.normal(size=len(body)), strict=True))
    rows = [row.model_copy(update=_moved(row, number, off)) for number, row in enumerate(rig.rows, 1)]
    prisms = [
        prism.model_copy(
            update={"offset_mm": tuple(np.add(prism.offset_mm, [off[f"prism.{prism.name}.{axis}"] for axis in "xyz"]))}
        )
        for prism in rig.prisms
    ]
    return RigTruth(rig.model_copy(update={"rows": tuple(rows), "prisms": tuple(prisms)}), seed, perturbation=0.0)


def _moved(row: Row, number: int, off: dict[str, float]) -> dict[str, float]:
    out = {}
    for name in row.identify:
        value, angle = off[f"row{number}.{name}"], name in {"alpha", "theta", "beta"}
        field = f"{name}_deg" if angle else f"{name}_mm"
        out[field] = getattr(row, field) + (math.degrees(value) if angle else value)
    return out


def true_parameters(chain: Chain, truth: RigTruth) -> Floats:
    """(p,) what the chain's parameters are at the true machine."""
    out = np.zeros(len(chain))
    constants = zip(truth.constants, nominal_constants(chain.rig), chain.rig.rows, strict=True)
    for number, (true_row, nominal, row) in enumerate(constants, 1):
        for name in row.identify:
            out[chain.index(f"row{number}.{name}")] = getattr(true_row, name) - getattr(nominal, name)
    for part in chain.rig.prisms:
        offset = [chain.index(f"prism.{part.name}.{axis}") for axis in "xyz"]
        out[offset] = truth.prism_offset_mm(part.name) - np.array(part.offset_mm)
    for setup, label in enumerate(chain.setups):
        base, start = truth.placement(label), chain.placements[label]
        r = base.rotation @ start.rotation.T  # Rot(z) Rot(y) Rot(x)
        angles = math.atan2(r[1, 0], r[0, 0]), math.asin(-r[2, 0]), math.atan2(r[2, 1], r[2, 2])
        out[chain.base_index(setup)] = [*(base.position_mm - start.translation_mm), *angles]
    return out


def session(setting: Setting, number: int) -> Errors:
    rig = shipped_rig(setting.rig)
    # The same machines in every setting would make one chance look like several that agree.
    seed = int(np.random.SeedSequence([number, zlib.crc32(repr(setting).encode())]).generate_state(1)[0])
    truth = machine(rig, seed, BUILT if setting.prior == "as-built" else 1.0)
    poses = FIXES if setting.prisms_per_pose == "one" else -(-FIXES // len(rig.prisms))
    training = simulate_observations(
        truth, poses, seed, prisms_per_pose=setting.prisms_per_pose, noise_mm=setting.noise_mm
    )
    table = parsed(training, rig)
    rng = np.random.default_rng([seed, 20])
    bad = rng.permutation(len(table))[: round(setting.outliers * len(table))]
    size_mm = np.exp(rng.uniform(math.log(100.0), math.log(5000.0), (len(bad), 1)))
    table.position_mm[bad] += size_mm * rng.normal(size=(len(bad), 3))
    chain, samples, start = place(rig, table)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    fit = refine(chain, samples, nominal.x, prior=setting.prior)
    sigma = np.sqrt(np.diag(fit.covariance))
    held_out = simulate_observations(truth, HELD_OUT, seed + 500_000, prisms_per_pose="one", noise_mm=setting.noise_mm)
    rows = parsed(held_out, rig)
    lin = chain.linearise(fit.x, chain.bind(rows))
    parameters = lin.jacobian @ fit.covariance @ lin.jacobian.transpose(0, 2, 1)
    noise = station_covariance(rig, rows.position_mm, rows.sigma_mm) + fit.excess_variance * np.eye(3)
    noise = noise + reading_covariance(rig, lin.joint_jacobian, np.zeros((len(rows), len(rig.joints))))
    prior_sigma = np.where(np.isinf(chain.prior_sigma), np.inf, chain.prior_sigma * fit.prior_scale)
    return Errors(
        (fit.x - true_parameters(chain, truth)) / sigma,
        np.array([f"{p.kind} {p.unit}" for p in chain.parameters]),
        sigma < 0.5 * prior_sigma,
        (held_out.oracle_mm - lin.position_mm) / _sigma(parameters),
        (held_out.measured_mm - lin.position_mm) / _sigma(parameters + noise),
    )


def parsed(simulated: SimulatedObservations, rig: Rig) -> Observations:
    return parse_observations(simulated.csv_text().encode(), rig, "simulated.csv")


@dataclass(frozen=True)
class Covered:
    """How many errors their 95 % intervals cover, of how many, and the standard error of the share over sessions."""

    inside: int
    of: int
    standard_error: float

    @property
    def share(self) -> float:
        return self.inside / self.of


def covered(sessions: Sequence[Floats]) -> Covered:
    """Count the errors of every session."""
    inside = np.array([(np.abs(errors) <= LEVEL).sum() for errors in sessions])
    of = np.array([errors.size for errors in sessions])
    share = inside.sum() / of.sum()
    spread = math.sqrt(float(((inside - share * of) ** 2).sum()) * len(of) / max(len(of) - 1, 1))
    return Covered(int(inside.sum()), int(of.sum()), spread / float(of.sum()))


def _sigma(covariance: Floats) -> Floats:
    sigma: Floats = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return sigma


def _groups(sessions: list[Errors]) -> Iterator[tuple[str, list[Floats]]]:
    yield "all", [s.parameter for s in sessions]
    yield "seen", [s.parameter[s.seen] for s in sessions]
    yield "unseen", [s.parameter[~s.seen] for s in sessions]
    for name in np.unique(sessions[0].kind):
        yield str(name), [s.parameter[s.kind == name] for s in sessions]
    yield "predictions", [s.prediction for s in sessions]
    yield "fixes", [s.fix for s in sessions]


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage of 95 % intervals on simulated sessions.")
    parser.add_argument("--rig", default="swdt82", choices=("swdt82", "ys100", "ur10"))
    parser.add_argument("--sessions", type=int, default=300)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--noise-mm", type=float, help="of each coordinate; the rig's own station where absent")
    options = parser.parse_args()
    several = len(shipped_rig(options.rig).prisms) > 1
    grid = itertools.product(get_args(PrismsPerPose) if several else ("one",), get_args(Prior), (0.0, OUTLIERS))
    for prisms, prior, outliers in grid:
        setting = Setting(options.rig, prisms, prior, outliers, options.noise_mm)
        sessions = [session(setting, seed) for seed in range(options.first, options.first + options.sessions)]
        print(f"{options.rig}, prisms per pose: {prisms}, prior {prior}, outliers {outliers:.0%}")
        for name, errors in _groups(sessions):
            found = covered(errors)
            low, high = binomtest(found.inside, found.of).proportion_ci(method="wilson")
            square = np.mean([np.square(e).sum() for e in errors]) / np.mean([e.size for e in errors])
            print(
                f"    {name:12s} {found.share:6.1%} of {found.of:6d}  [{low:.1%}, {high:.1%}]"
                f"  +- {found.standard_error:.1%}   mean square {square:6.3f}",
                flush=True,
            )


if __name__ == "__main__":
    with threadpool_limits(1, user_api="blas"):
        main()
