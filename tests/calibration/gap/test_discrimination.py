"""What data could show, and what would tell effects apart that they cannot."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.resources import files

import numpy as np
import pytest

from calibration.design.candidates import draw, near
from calibration.design.conditions import DWELLS_S, FIXES, ROUNDS_S
from calibration.design.knowledge import Knowledge
from calibration.design.poses import plan, whitened
from calibration.design.visibility import Bodies, in_view, is_reachable, placement, site
from calibration.effects.base import Settings
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library
from calibration.errors import DataError
from calibration.gap.adoption import Adopted
from calibration.gap.candidates import candidate_at, candidate_effects
from calibration.gap.criteria import better_text, with_same_family
from calibration.gap.discrimination import POSES, propose_experiments
from calibration.gap.forecast import forecasts
from calibration.gap.projected.projection import Projection, from_products
from calibration.gap.result import Experiment, Forecast
from calibration.gap.screening import ScoredEffect, Screen
from calibration.identification.identifiability import identifiability
from calibration.identification.refinement import refine
from calibration.identification.solve import Solution, place
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.build_model import build_model
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.dataset import random_poses
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SHORT_DEG = 8.0
PAIR = ("encoder_harmonic", "angle_scale")


@dataclass(frozen=True)
class Measured:
    """A machine and what was measured of it."""

    truth: RigTruth
    observations: Observations
    solution: Solution

    @property
    def context(self) -> EffectContext:
        chain = self.solution.chain
        return EffectContext(chain, self.solution.fit.x[: len(chain)], self.observations)

    @cached_property
    def model(self) -> CalibratedModel:
        text = (files("calibration") / "rigs" / "swdt82.toml").read_text()
        adopted = Adopted(self.solution, self.solution.fit)
        return build_model(self.truth.rig, text, self.observations, adopted, "recalibration", {"seed": 0})

    def screen(self, *families: str) -> Screen:
        projection = Projection(self.solution, self.context)
        return Screen(projection, candidate_effects(self.context, projection, families).candidates)

    def evidence(self, *effects: str) -> dict[str, ScoredEffect]:
        scored = self.screen(*{effect.partition("@")[0] for effect in effects}).score()
        return {str(w.candidate): w for w in scored if str(w.candidate) in effects}

    def found(self, *effects: str) -> list[list[FittedEffect]]:
        by_name = self.evidence(*effects)
        return [[by_name[effect].fitted(self.context)] for effect in effects]

    def in_form(self, effect: str, settings: Settings) -> list[FittedEffect]:
        """As the data have it, if it is of this form."""
        family, _, where = effect.partition("@")
        projection = Projection(self.solution, self.context)
        place = candidate_at(self.context, projection, family, where, [Choice(family, where, settings)])
        return [w.fitted(self.context) for w in Screen(projection, [place]).score()]


def measure(truth: RigTruth, poses: dict[str, Floats], seed: int) -> Observations:
    data = simulate_observations(truth, len(next(iter(poses.values()))), seed, poses=poses, prisms=("r", "b"))
    return parse_observations(data.csv_text().encode(), truth.rig, "simulated.csv")


def reselect(truth: RigTruth, observations: Observations) -> Measured:
    """With the nominal machine as the start, which needs no search."""
    chain, samples, start = place(truth.rig, observations)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    fit = refine(chain, samples, nominal.x)
    seen = identifiability(chain, samples, fit.x, fit.excess_variance)
    return Measured(truth, observations, Solution(chain, samples, nominal, fit, seen, "", 0.0))


def hidden(effect: str, seed: int, poses: int = 60) -> Measured:
    """A machine that was measured with theta4 in a short range."""
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, seed, effects=parse_effects(effect))
    drawn = random_poses(rig, poses, np.random.default_rng([seed, 5]))
    middle = sum(rig.joint("theta4").limits) / 2.0
    drawn["theta4"] = middle + SHORT_DEG * (np.random.default_rng([seed, 6]).random(poses) - 0.5)
    return reselect(truth, measure(truth, drawn, seed))


def more(case: Measured, experiment: Experiment, seed: int) -> Measured:
    """The same with proposed poses measured as well."""
    rig = case.truth.rig
    poses = {j.name: np.array([float(str(row[j.column])) for row in experiment.poses]) for j in rig.joints}
    extra = measure(case.truth, poses, seed)
    offset = len(case.observations)
    extra = replace(extra, pose=np.array([f"{int(p) + offset}" for p in extra.pose]))
    return reselect(case.truth, together(case.observations, extra))


def together(one: Observations, other: Observations) -> Observations:
    def both(a: Floats, b: Floats) -> Floats:
        joined: Floats = np.concatenate([a, b])
        return joined

    return Observations(
        np.concatenate([one.prism, other.prism]),
        {name: both(one.joints[name], other.joints[name]) for name in one.joints},
        both(one.position_mm, other.position_mm),
        both(one.sigma_mm, other.sigma_mm),
        np.concatenate([one.setup, other.setup]),
        np.concatenate([one.session, other.session]),
        np.concatenate([one.pose, other.pose]),
        {name: both(one.extra[name], other.extra[name]) for name in one.extra},
    )


@pytest.fixture(scope="module")
def rig() -> Rig:
    return shipped_rig("swdt82")


@pytest.fixture(scope="module")
def short() -> Measured:
    return hidden("encoder_harmonic@theta4:k=1:cosk_rad=1e-3:sink_rad=5e-3", 3)


# -- poses -------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_proposed_poses_tell_apart_what_the_data_could_not(short: Measured) -> None:
    truth, alternative = "encoder_harmonic@theta4", "angle_scale@theta4"
    before = short.evidence(truth, alternative)
    assert min(w.log_bayes_factor for w in before.values()) > 5.0
    assert abs(before[truth].log_bayes_factor - before[alternative].log_bayes_factor) < 5.0
    proposed, *_ = propose_experiments(
        short.model, short.observations, short.found(truth, alternative), np.random.default_rng(0)
    )
    assert proposed.kind == "poses"
    assert len(proposed.poses) == POSES
    assert f"{truth} by {proposed.stands_out_sigma[truth]:.1f} sigma" in proposed.text
    after = more(short, proposed, 11).evidence(truth, alternative)
    assert after[truth].log_bayes_factor > after[alternative].log_bayes_factor + 5.0


def test_what_was_measured_counts_when_poses_are_chosen(short: Measured) -> None:
    model, alternatives = short.model, short.found("encoder_harmonic@theta4", "angle_scale@theta4")
    knowledge = Knowledge.before(model, 0)
    at = site(model.chain, model.values, setup=0)
    candidates = draw(knowledge, at, np.random.default_rng(0), 300)
    alone = plan(knowledge, candidates, 10, separate=alternatives)
    with_data = plan(knowledge, candidates, 10, separate=alternatives, measured=short.observations)
    assert list(with_data.stands_out) == list(alone.stands_out)
    for name, sigma in with_data.stands_out.items():
        # The data have fixed the kinematics, behind which an effect could hide in the poses alone.
        assert sigma > alone.stands_out[name]


def test_a_plan_tells_an_effect_from_all_forms_of_another_that_the_data_leave_open(short: Measured) -> None:
    knowledge = Knowledge.before(short.model, 0)
    at = site(short.model.chain, short.model.values, setup=0)
    candidates = draw(knowledge, at, np.random.default_rng(0), 300)
    scale, once, twice = (
        short.in_form(*form)
        for form in (
            ("angle_scale@theta4", {}),
            ("encoder_harmonic@theta4", {"k": 1}),
            ("encoder_harmonic@theta4", {"k": 2}),
        )
    )
    planned = {
        len(other): plan(knowledge, candidates, 10, separate=[scale, other], measured=short.observations)
        for other in (twice, twice + once)
    }
    said = {number: found.stands_out["angle_scale@theta4"] for number, found in planned.items()}
    # The poses that tell it best from one form do not tell it from the other.
    same = candidates.select(np.flatnonzero(np.isin(candidates.readings, planned[1].poses.readings).all(axis=1)))
    really = plan(knowledge, same, 10, separate=[scale, twice + once], measured=short.observations)
    assert really.stands_out["angle_scale@theta4"] < said[2] < said[1]


def test_what_a_set_is_told_from_has_the_forms_and_places_that_come_near(short: Measured) -> None:
    screen = short.screen("encoder_harmonic")
    scored = screen.score()
    near = with_same_family(scored[0], screen, scored)
    assert str(near.candidate) == "encoder_harmonic@theta4"
    assert {str(w.candidate) for w in near.same_family} == {"encoder_harmonic@theta4"}
    assert near.choice.settings not in [w.choice.settings for w in near.same_family]


@pytest.mark.long
def test_every_effect_of_the_library_can_be_planned_for_but_for_what_no_pose_brings_about(rig: Rig) -> None:
    rig = rig.with_signals("tilt_x_deg", "tilt_y_deg")
    blank = Chain(rig, {"": Placement.identity()})
    at = site(blank, np.zeros(len(blank)))
    knowledge = Knowledge.of_rig(Chain(rig, {"": placement(at)}))
    candidates = draw(knowledge, at, np.random.default_rng(0), 60)
    needed: dict[str, set[str]] = {}
    for name, family in library().items():
        where = family.places(rig)[-1]
        other = "angle_scale@theta5"
        separate = (f"{name}@{where}",) if name == "angle_scale" else (f"{name}@{where}", other)
        if name == "measured_tilt":
            with pytest.raises(DataError, match="tilt_x_deg and tilt_y_deg, which poses alone do not give"):
                plan(knowledge, candidates, 4, separate=separate)
            continue
        planned = plan(knowledge, candidates, 4, separate=separate)
        assert all(np.isfinite(sigma) and sigma >= 0.0 for sigma in planned.stands_out.values()), name
        needed[name] = set(planned.poses.conditions)
    assert needed["backlash"] == {"theta8_dir", "fixes"}
    assert needed["latency"] == {f"{name}_rate" for name in rig.joint_names} | {"fixes"}
    assert needed["clock_drift"] == {"time_s"} | needed["latency"]
    assert needed["leak_down"] == {"dwell_s", "fixes"}
    assert needed["payload_change"] == needed["boom_droop"] == {"payload_kg", "fixes"}
    assert needed["thermal_expansion"] == {"temperature_degC", "fixes"}
    assert needed["prism_constant"] == {"fixes"}


def test_a_plan_varies_what_changes_one_effect_and_not_the_other(short: Measured) -> None:
    alternatives = [[of_plausible_size(short, f"{name}@theta4")] for name in ("load_hysteresis", "backlash")]
    loaded = replace(short.observations, extra={"payload_kg": np.full(len(short.observations), 300.0)})
    proposed, *_ = propose_experiments(short.model, loaded, alternatives, np.random.default_rng(0), poses=8)
    # As heavy as the machine has carried: the rig file does not say what its rods weigh.
    assert {row["payload_kg"] for row in proposed.poses} == {0.0, 300.0}
    assert {row["theta4_dir"] for row in proposed.poses} == {-1, 1}
    assert "carry payload_kg" in proposed.text


@pytest.mark.long
def test_a_plan_waits_only_where_time_tells(short: Measured) -> None:
    times = np.linspace(0.0, 28800.0, len(short.observations))
    timed = replace(short.observations, extra=dict(short.observations.extra) | {"time_s": times})
    context = replace(short.context, observations=timed)
    hours = {}
    for pair in (("transducer_index_jump@L3", "transducer_cumulative@L3"), ("base_settlement@base", "base_step@base")):
        alternatives: list[list[FittedEffect]] = []
        for name, _, where in (effect.partition("@") for effect in pair):
            settings = library()[name].variants(context, where)[0]
            sigma = np.array([c.sigma for c in library()[name].coefficients(context, where, settings)])
            alternatives.append([Choice(name, where, settings).fitted(context, sigma, 0.1 * sigma)])
        proposed, *_ = propose_experiments(short.model, timed, alternatives, np.random.default_rng(0), poses=8)
        taken = np.array([float(str(row["time_s"])) for row in proposed.poses])
        hours[pair[0]] = float(np.ptp(taken)) / 3600.0
    assert hours["transducer_index_jump@L3"] < 1.0  # a minute a pose
    assert hours["base_settlement@base"] > ROUNDS_S[1] / 3600.0


def test_several_fixes_of_a_pose_show_effects_better_and_none_is_repeated_on_the_move(rig: Rig) -> None:
    blank = Chain(rig, {"": Placement.identity()})
    at = site(blank, np.zeros(len(blank)))
    knowledge = Knowledge.of_rig(Chain(rig, {"": placement(at)}))
    poses = draw(knowledge, at, np.random.default_rng(0), 200).under({"fixes"})
    once = replace(poses, conditions={"fixes": np.ones(len(poses))})
    assert poses.fixes_in_all == FIXES * once.fixes_in_all
    information = [float((whitened(knowledge, some) ** 2).sum()) for some in (once, poses)]
    assert 1.5 * information[0] < information[1] < FIXES * information[0]  # the readings err as they did
    rows = plan(
        knowledge,
        draw(knowledge, at, np.random.default_rng(0), 200),
        12,
        separate=("latency@clock", PAIR[0] + "@theta4"),
    ).poses
    moves = np.any([rows.conditions[f"{name}_rate"] for name in rig.joint_names], axis=0)
    assert (rows.fixes == np.where(moves, 1, FIXES)).all()


@pytest.mark.long
def test_poses_near_the_best_show_effects_better(short: Measured) -> None:
    model, alternatives = short.model, short.found("encoder_harmonic@theta4", "angle_scale@theta4")
    knowledge = Knowledge.before(model, 0)
    at, rng = site(model.chain, model.values, setup=0), np.random.default_rng(0)
    candidates = draw(knowledge, at, rng, 300)
    drawn = plan(knowledge, candidates, 10, separate=alternatives)
    closer = plan(knowledge, candidates, 10, separate=alternatives, nearby=partial(near, knowledge, at, rng))
    assert min(closer.stands_out.values()) > min(drawn.stands_out.values())
    bodies = Bodies.of(knowledge.chain, knowledge.x, closer.poses.readings)
    assert is_reachable(bodies, at).all()
    assert (in_view(bodies, at) >= closer.poses.seen).all()


def test_poses_that_need_a_slow_condition_are_measured_in_blocks(rig: Rig) -> None:
    blank = Chain(rig, {"": Placement.identity()})
    at = site(blank, np.zeros(len(blank)))
    knowledge = Knowledge.of_rig(Chain(rig, {"": placement(at)}))
    candidates = draw(knowledge, at, np.random.default_rng(0), 200, begin_s=500.0)
    alternatives = ("base_settlement@base", "leak_down@theta4", "angle_scale@theta4")
    planned = plan(knowledge, candidates, 12, separate=alternatives)
    assert list(planned.stands_out) == list(alternatives)
    times, dwells = planned.poses.conditions["time_s"], planned.poses.conditions["dwell_s"]
    assert (np.diff(times) > 0.0).all()
    assert {500.0 + ROUNDS_S[0], 500.0 + ROUNDS_S[-1]} <= set(times)
    assert set(dwells) == set(DWELLS_S)


def test_what_grows_with_travel_is_planned_with_travel(rig: Rig) -> None:
    blank = Chain(rig, {"": Placement.identity()})
    at = site(blank, np.zeros(len(blank)))
    knowledge = Knowledge.of_rig(Chain(rig, {"": placement(at)}))
    candidates = draw(knowledge, at, np.random.default_rng(0), 200)
    index = rig.joint_names.index("L3")
    plans = [
        plan(knowledge, candidates, 12, separate=(effect, "prism_constant@r"))
        for effect in ("transducer_cumulative@L3", "transducer_quadratic@L3")
    ]
    length = plans[0].poses.readings[:, index]
    assert np.abs(np.diff(length)).sum() > 1.6 * np.abs(length - length.mean()).sum()  # of 2
    assert plans[0].seconds_of_motion > 1.2 * plans[1].seconds_of_motion


def test_a_boom_on_the_move_has_not_stood(rig: Rig) -> None:
    blank = Chain(rig, {"": Placement.identity()})
    at = site(blank, np.zeros(len(blank)))
    knowledge = Knowledge.of_rig(Chain(rig, {"": placement(at)}))
    candidates = draw(knowledge, at, np.random.default_rng(0), 200)
    planned = plan(knowledge, candidates, 12, separate=("latency@clock", "leak_down@theta4")).poses
    moves = np.any([planned.conditions[f"{name}_rate"] for name in rig.joint_names], axis=0)
    assert 0 < moves.sum() < 12
    assert ((planned.conditions["dwell_s"] == 0.0) == moves).all()


# -- experiments that are no poses -------------------------------------------------------------------------------------


def by_kind(case: Measured, *effects: FittedEffect) -> dict[str, str]:
    answers = [[effect] for effect in effects]
    found = propose_experiments(case.model, case.observations, answers, np.random.default_rng(0), poses=3)
    return {experiment.kind: experiment.text for experiment in found}


def of_plausible_size(case: Measured, effect: str) -> FittedEffect:
    name, _, where = effect.partition("@")
    knowledge = Knowledge.before(case.model, 0)
    at = site(case.model.chain, case.model.values, setup=0)
    poses = draw(knowledge, at, np.random.default_rng(1), 30)
    context = knowledge.context(poses.readings, poses.conditions)
    settings = library()[name].variants(context, where)[0]
    sigma = np.array([c.sigma for c in library()[name].coefficients(context, where, settings)])
    return Choice(name, where, settings).fitted(context, sigma, 0.1 * sigma)


@pytest.mark.long
@pytest.mark.parametrize(
    ("alternatives", "kind", "changed", "left"),
    [
        (("load_hysteresis@theta4", "backlash@theta4"), "payload", "load_hysteresis@theta4", "backlash@theta4"),
        (("backlash@theta4", "encoder_harmonic@theta4"), "approach", "backlash@theta4", "encoder_harmonic@theta4"),
        (("leak_down@theta4", "joint_compliance@theta4"), "dwell", "leak_down@theta4", "joint_compliance@theta4"),
        (("latency@clock", "backlash@theta4"), "motion", "latency@clock", "backlash@theta4"),
        (("thermal_expansion@boom", "station_scale@station"), "temperature", "thermal_expansion@boom", "station"),
        (("base_settlement@base", "joint_compliance@theta4"), "repeat", "base_settlement@base", "joint_compliance"),
        (
            ("station_scale@station", "transducer_scale@L2"),
            "control_points",
            "station_scale@station",
            "transducer_scale",
        ),
        (
            ("joint_compliance@theta4", "joint_compliance@theta6"),
            "prism",
            "joint_compliance@theta4",
            "compliance@theta6",
        ),
    ],
)
def test_experiments_follow_from_what_the_rivals_do(
    short: Measured, alternatives: tuple[str, str], kind: str, changed: str, left: str
) -> None:
    found = by_kind(short, *(of_plausible_size(short, alternative) for alternative in alternatives))
    assert kind in found
    assert changed in found[kind]
    assert left in found[kind].split(changed)[1]
    assert library()[alternatives[1].partition("@")[0]].revealed_by in found["procedure"]


# -- forecast ----------------------------------------------------------------------------------------------------------


def forecast_of(screen: Screen) -> dict[str, Forecast]:
    return {f"{f.family}@{f.where}": f for f in forecasts(screen)}


def test_a_forecast_tells_what_calibration_and_rivals_leave_of_an_effect(short: Measured) -> None:
    found = forecast_of(short.screen(*PAIR, "backlash", "transducer_scale", "gravity_flip_play"))
    assert all(0.0 <= f.visible <= 1.0 and 0.0 <= f.separation <= 1.0 for f in found.values())
    # Half the poses come from either side, which no constant of the machine imitates.
    assert found["backlash@theta4"].visible > 0.7
    assert found["angle_scale@theta4"].visible < 0.3
    assert found["angle_scale@theta4"].alternative == "encoder_harmonic@theta4"
    assert found["angle_scale@theta4"].separation < 0.1 < found["backlash@theta4"].separation
    assert found["angle_scale@theta4"].nameable == np.inf
    assert found["backlash@theta4"].nameable < 5e-3
    assert found["backlash@theta4"].unit == "rad"


def test_an_effect_of_the_forecast_size_stands_out_and_one_of_half_the_size_does_not(short: Measured) -> None:
    screen = short.screen("backlash", *PAIR)
    names = [str(p) for p in screen.candidates]
    own = names.index("backlash@theta3")
    size = forecast_of(screen)["backlash@theta3"].nameable
    columns, sigma = screen.columns(own, 0), screen.candidates[own].additions[0].prior_sigma
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((400, len(columns)))
    needed = max(5.0, np.log(19.0) - screen.candidates[own].log_prior)
    for share, above in ((1.0, True), (0.5, False)):
        residuals = share * size * columns[:, 0] + noise
        mean = np.mean([from_products(columns.T @ columns, columns.T @ residual, sigma) for residual in residuals])
        assert mean == pytest.approx(needed, rel=0.1) if above else mean < 0.5 * needed


@pytest.mark.parametrize(
    ("log_odds", "words"),
    [(0.0, "1 times"), (math.log(400.0), "400 times"), (12.0, "e^12 times"), (3083.0, "overwhelmingly")],
)
def test_odds_without_meaning_are_a_word(log_odds: float, words: str) -> None:
    assert better_text("backlash@q1", log_odds) == f"backlash@q1 explains the data {words} better"
