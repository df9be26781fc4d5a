"""What the residual's `default` is worth against one learner alone: `python -m tests.bench.residual`.

A simulated boom creeps through runs with friction, deflection and an error that depends on valve currents, all of
them together, at several magnitudes, and with the 66 features of Zhou et al. (2022): 9 joint values, 27 frame
coordinates, 30 control signals. Runs are the groups, or 100 mm workspace cells; no group is both trained on and held
out. Each seed is its own machine. The table gives mean and spread (standard deviation) of the 3-D error on held-out
groups, averaged over seeds, and tests over the seeds whether `default` and the better single learner differ.

    python -m tests.bench.residual --seeds 2 --magnitudes 1 --effects none     a quick look
    python -m tests.bench.residual --layout cells --search 12                  cells; LightGBM tuned by a search too
    python -m tests.bench.residual --nothing --seeds 20                        how often the residual is switched off
    python -m tests.bench.residual --timing 2000 20000                         how long training takes
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calibration.evaluation.evaluation import evaluate
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.residual.features import usable_signals
from calibration.residual.selection import Kind
from calibration.rig.description import shipped_rig
from calibration.run_settings import Run
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.bench.tuned_boosting import tune_boosting
from tests.calibration.conftest import rig_text
from tests.simulated.observations import simulate_observations
from tests.simulated.runs import simulate_runs

Floats = NDArray[np.float64]

RIG = "swdt82"
PRISMS = ("r", "s")
FIXES_OF_A_RUN = 40
FIXES_OF_A_LEG = 8
Layout = Literal["runs", "cells"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
SINGLES: tuple[Kind, ...] = ("rbfn", "lightgbm")
KINDS: tuple[Kind, ...] = get_args(Kind)
HYBRID: Literal["default"] = "default"
NO_RESIDUAL = "no residual"
PAPER = "the paper: mean -26 %, spread -39 % (its chain against LightGBM alone, one trajectory of 200 points)"
BARS = "2000 in 20 s, 20000 in 120 s, on two cores"
HELD_OUT = 500_000  # seeds of held-out runs are that much higher


def boom(seed: int, magnitude: float) -> RigTruth:
    """A machine; at magnitude 1 its imperfections are of plausible size, at 0 it has none beyond its build."""
    if magnitude == 0.0:
        return RigTruth(shipped_rig(RIG), seed)
    text = (
        f"load_hysteresis@theta4:rad_per_Nm={2e-9 * magnitude}:stiction_share=0.5,"
        f"boom_droop@boom:flexibility_per_Nm2={4e-9 * magnitude},"
        f"stiffening_compliance@theta8:soft_rad_per_Nm={8e-7 * magnitude}:stiff_rad_per_Nm={1e-7 * magnitude}"
        ":knee_Nm=5000,"
        f"valve_current_error@theta4:rad_at_rated={2e-3 * magnitude},"
        f"valve_current_error@theta3:rad_at_rated={2e-3 * magnitude}"
    )
    return RigTruth(shipped_rig(RIG), seed, effects=parse_effects(text))


@dataclass(frozen=True)
class Setting:
    """What is compared.

    Attributes:
        fixes: to train on, and about as many held out.
        layout: `runs` of 40 fixes, each a session and so a group; or `cells`: one fix at random from each of many short
            runs, without a session, so that workspace cells are the groups.
        against: learners alone.
        search: settings that LightGBM is tuned over, apart from the residual's own; 0 leaves that out.
    """

    fixes: int
    layout: Layout
    against: tuple[Kind, ...] = ()
    search: int = 0


def fixes(truth: RigTruth, n: int, seed: int, layout: Layout) -> tuple[Observations, Floats]:
    """n fixes with every control signal, and (n,) their errors, mm."""
    of_a_run = FIXES_OF_A_RUN if layout == "runs" else FIXES_OF_A_LEG
    count = -(-n // FIXES_OF_A_RUN) if layout == "runs" else n
    simulated = simulate_runs(truth, count, of_a_run, seed, prisms=PRISMS)
    table = parse_observations(simulated.csv_text().encode(), truth.rig, "simulated.csv")
    rows = np.arange(n)
    if layout == "cells":
        rows = rows * FIXES_OF_A_LEG + np.random.default_rng([seed, 41]).integers(FIXES_OF_A_LEG, size=n)
        table = replace(table, session=np.full(len(table), "", dtype=np.str_))
    return table.select(rows), np.linalg.norm(simulated.measured_mm - simulated.oracle_mm, axis=1)[rows]


def train_and_held_out(truth: RigTruth, seed: int, setting: Setting) -> tuple[Observations, Observations, float]:
    """Two tables that share no group, and the RMS noise of the second, mm."""
    training, _ = fixes(truth, setting.fixes, seed, setting.layout)
    held_out, noise_mm = fixes(truth, setting.fixes, seed + HELD_OUT, setting.layout)
    apart = np.ones(len(held_out), dtype=bool)
    if setting.layout == "cells":  # runs are others by themselves
        apart = ~np.isin(held_out.cells(), training.cells())
    return training, held_out.select(apart), float(np.sqrt(np.mean(noise_mm[apart] ** 2)))


@dataclass(frozen=True)
class Outcome:
    """One machine.

    Attributes:
        mean_mm, std_mm: method -> of the held-out 3-D error; `no residual` is the model before any learner.
        chosen: method -> the learner that it kept, or `none`.
        effects: what was adopted.
        noise_mm: RMS, of the held-out fixes.
        covered: share of held-out errors of x, y and z inside the 90 % intervals of `default`, and of balls.
        seconds: that `default` took to train.
    """

    mean_mm: dict[str, float]
    std_mm: dict[str, float]
    chosen: dict[str, str]
    effects: tuple[str, ...]
    noise_mm: float
    covered: tuple[float, float]
    seconds: float

    @property
    def single(self) -> str:
        """The single learner with the lesser held-out mean: known in hindsight alone."""
        return min((m for m in self.mean_mm if m not in (NO_RESIDUAL, HYBRID)), key=self.mean_mm.__getitem__)


def outcome(seed: int, magnitude: float, effects: str, setting: Setting) -> Outcome:
    """Calibrate one machine with each method and measure it where it was never seen."""
    truth = boom(seed, magnitude)
    training, held_out, noise_mm = train_and_held_out(truth, seed, setting)
    model = identify(truth.rig, rig_text(RIG), training, run=Run(seed), effects=effects)
    plain_mm = held_out.position_mm - Predictor.of(model).effects_mm(held_out)
    errors_mm, seconds, covered = {NO_RESIDUAL: plain_mm}, 0.0, (0.0, 0.0)
    chosen: dict[str, str] = {}
    for method in (*setting.against, HYBRID):
        began = time.perf_counter()
        trained = train_residual(model, training, kind=method, run=Run(seed))
        seconds = time.perf_counter() - began
        evaluation = evaluate(trained, held_out)
        errors_mm[method] = evaluation.errors_mm["hybrid"]
        covered = float(np.mean(evaluation.coverage.axes)), evaluation.coverage.radius
        chosen[method] = trained.residual.learner.kind if trained.residual else "none"
    if setting.search:
        errors_mm["tuned lightgbm"] = plain_mm - tuned_estimate_mm(model, training, held_out, seed, setting.search)
    norms = {method: np.linalg.norm(error, axis=1) for method, error in errors_mm.items()}
    return Outcome(
        {method: float(norm.mean()) for method, norm in norms.items()},
        {method: float(norm.std()) for method, norm in norms.items()},
        chosen,
        tuple(f"{effect.family}@{effect.where}" for effect in model.effects),
        noise_mm,
        covered,
        seconds,
    )


def tuned_estimate_mm(
    model: CalibratedModel, training: Observations, held_out: Observations, seed: int, trials: int
) -> Floats:
    """(n, 3) what trees tuned apart from the residual's own say of held-out rows, in the station's frame."""
    signals = usable_signals(training)
    target_mm = Predictor.of(model).to_base(training, training.position_mm - Predictor.of(model).effects_mm(training))
    table = Predictor.of(model).features(training, signals).table()
    trees = tune_boosting(table, target_mm, training.groups(), seed=seed, trials=trials)
    return Predictor.of(model).to_station(
        held_out, trees.predict(Predictor.of(model).features(held_out, signals).table())
    )


def summary(outcomes: Sequence[Outcome]) -> None:
    """Means over seeds, and whether `default` differs from the best single learner."""
    methods = tuple(outcomes[0].mean_mm)
    means = {m: np.array([o.mean_mm[m] for o in outcomes]) for m in methods}
    spreads = {m: np.array([o.std_mm[m] for o in outcomes]) for m in methods}
    for method in methods:
        kept = Counter(o.chosen[method] for o in outcomes if method in o.chosen)
        how = ", ".join(f"{name} {count}" for name, count in kept.most_common())
        print(f"    {method:15} mean {means[method].mean():7.3f}  spread {spreads[method].mean():7.3f}  {how}")
    best = min((m for m in methods if m not in (NO_RESIDUAL, HYBRID)), key=lambda m: means[m].mean())
    for name, values in (("mean", means), ("spread", spreads)):
        change = 100.0 * (values[HYBRID].mean() / values[best].mean() - 1.0)
        print(f"    default against {best}: {name} {change:+.1f} %, {paired(values[HYBRID], values[best])}")
    hindsight = np.array([o.mean_mm[o.single] for o in outcomes])
    change = 100.0 * (means[HYBRID].mean() / hindsight.mean() - 1.0)
    print(f"    default against each seed's better one: mean {change:+.1f} %, {paired(means[HYBRID], hindsight)}")
    axes, balls = np.mean([o.covered for o in outcomes], axis=0)
    print(f"    90 % intervals cover {axes:.3f} of x, y, z and {balls:.3f} of balls", end="; ")
    print(f"noise {np.mean([o.noise_mm for o in outcomes]):.2f} mm RMS", end="; ")
    print(f"default trains in {np.mean([o.seconds for o in outcomes]):.1f} s")


def paired(ours: Floats, theirs: Floats) -> str:
    """Seeds won and lost, and the two-sided paired t-test."""
    won, lost = int((ours < theirs).sum()), int((ours > theirs).sum())
    spread = float((ours - theirs).std(ddof=1)) if len(ours) > 1 else 0.0
    p = float(stats.ttest_rel(ours, theirs).pvalue) if spread > 0.0 else 1.0
    return f"better {won}, worse {lost} of {len(ours)}, p = {p:.2g}"


def compare(seeds: Sequence[int], magnitudes: Sequence[float], modes: Sequence[str], setting: Setting) -> None:
    """The table."""
    print(
        f"{setting.fixes} fixes to train on, as many held out, {setting.layout} are the groups; 3-D error, mm; {PAPER}"
    )
    for effects in modes:
        for magnitude in magnitudes:
            print(f"effects {effects}, magnitude {magnitude:g}", flush=True)
            found: list[Outcome] = []
            for seed in seeds:
                one = outcome(seed, magnitude, effects, setting)
                found.append(one)
                figures = "  ".join(f"{m} {one.mean_mm[m]:.2f}/{one.std_mm[m]:.2f}" for m in one.mean_mm)
                kept = f"kept {one.chosen[HYBRID]}, {', '.join(one.effects) or 'no effects'}"
                print(f"  seed {seed}: {figures}; {kept}", flush=True)
            summary(found)


def nothing(seeds: Sequence[int], effects: str, n: int) -> None:
    """Machines with no imperfection that kinematics lack, in runs and in poses held: runs and cells are the groups."""
    for source in ("runs", "poses"):
        off = 0
        for seed in seeds:
            truth = boom(seed, 0.0)
            training = fixes(truth, n, seed, "runs")[0] if source == "runs" else poses(truth, n, seed)
            model = identify(truth.rig, rig_text(RIG), training, run=Run(seed), effects=effects)
            trained = train_residual(model, training, run=Run(seed))
            off += trained.residual is None
            trials = ", ".join(f"{t.kind} {t.before_mm:.3f} -> {t.after_mm:.3f} p {t.p:.2g}" for t in trained.trials)
            kept = trained.residual.learner.kind if trained.residual else "none"
            print(f"  {source}, seed {seed}: {kept}; {trials}", flush=True)
        print(f"nothing to learn from {source}, effects {effects}: off in {off} of {len(seeds)} (bar: 19 of 20)")


def poses(truth: RigTruth, n: int, seed: int) -> Observations:
    """n fixes of the four prisms in random poses, without any machine signal."""
    simulated = simulate_observations(truth, n // len(truth.rig.prisms), seed)
    return parse_observations(simulated.csv_text().encode(), truth.rig, "simulated.csv")


def timing(n: int, seed: int) -> None:
    """Train `default` once."""
    truth = boom(seed, 1.0)
    training, _ = fixes(truth, n, seed, "runs")
    model = identify(truth.rig, rig_text(RIG), training.select(np.arange(min(n, 1000))), run=Run(seed), effects="none")
    count = len(truth.rig.joints) + 3 * len(truth.rig.rows) + len(usable_signals(training))
    began, used = time.perf_counter(), time.process_time()
    trained = train_residual(model, training, run=Run(seed))
    seconds, cpu = time.perf_counter() - began, time.process_time() - used
    kept = trained.residual.learner.kind if trained.residual else "none"
    print(f"{n} x {count} features: {seconds:.1f} s ({cpu:.1f} s of processors), kept {kept} (bars: {BARS})")


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1000, help="report on 1000 and above, tune below 100")
    parser.add_argument("--magnitudes", type=float, nargs="+", default=[0.5, 1.0, 2.0, 4.0])
    parser.add_argument("--effects", nargs="+", default=["none", "auto"], help="as calibrate's --effects")
    parser.add_argument("--fixes", type=int, default=1000, help="to train on, and as many held out")
    parser.add_argument("--layout", default="runs", choices=LAYOUTS, help="what the groups are")
    parser.add_argument("--against", nargs="+", default=SINGLES, choices=KINDS, help="the learners alone")
    parser.add_argument("--search", type=int, default=0, metavar="TRIALS", help="also tune LightGBM apart from ours")
    parser.add_argument("--nothing", action="store_true", help="machines with nothing left to learn instead")
    parser.add_argument("--timing", nargs="+", type=int, metavar="FIXES", help="training time at so many fixes instead")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    if options.timing:
        for n in options.timing:
            timing(n, options.first)
    elif options.nothing:
        for effects in options.effects:
            nothing(seeds, effects, options.fixes)
    else:
        setting = Setting(options.fixes, options.layout, tuple(options.against), options.search)
        compare(seeds, options.magnitudes, options.effects, setting)


if __name__ == "__main__":
    main()
