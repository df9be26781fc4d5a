"""The library of effects as a whole: what every file in it promises, walked over one by one."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from calibration.effects import families
from calibration.effects.base import Family, FittedCoefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library, parse_effects
from calibration.kinematics.chain import Chain, Placement
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session
from tests.simulated.observations import simulate_observations

# A promise: what outputs call the coefficients of each family.
REPORTED = {
    "joint_compliance": ("compliance_rad_per_Nm",),
    "boom_droop": ("flexibility_per_Nm2",),
    "pad_play": ("clearance_mm",),
    "backlash": ("width_rad",),
    "gravity_flip_play": ("width_rad",),
    "load_hysteresis": ("rad_per_Nm",),
    "encoder_harmonic": ("cosk_rad", "sink_rad"),
    "joint_error_map": ("rms_rad",),
    "angle_scale": ("scale",),
    "transducer_scale": ("scale",),
    "transducer_quadratic": ("mm_per_m2",),
    "transducer_index_jump": ("jump_mm", "time_s"),
    "transducer_cumulative": ("mm_per_m",),
    "thermal_expansion": ("per_K",),
    "solar_bow": ("rad_per_K",),
    "base_settlement": ("tilt_x_rad_per_h", "tilt_y_rad_per_h", "z_mm_per_h"),
    "base_step": ("tilt_x_rad", "tilt_y_rad", "z_mm", "time_s"),
    "base_compliance": ("x_rad_per_Nm", "y_rad_per_Nm"),
    "base_shift": ("x_mm", "y_mm", "heading_rad", "time_s"),
    "measured_tilt": tuple(f"about_{axis}_by_{reading}_rad_per_deg" for reading in "xy" for axis in "xy"),
    "zero_step": ("jump_rad", "time_s"),
    "prism_seat_step": ("x_mm", "y_mm", "z_mm", "time_s"),
    "lateral_compliance": ("compliance_rad_per_Nm",),
    "passive_compliance": ("compliance_rad_per_Nm",),
    "payload_change": ("compliance_rad_per_Nm",),
    "cylinder_compression": ("mm_per_bar",),
    "leak_down": ("rad_per_s",),
    "latency": ("seconds",),
    "clock_drift": ("ppm",),
    "station_scale": ("ppm",),
    "prism_constant": ("mm",),
    "prism_incidence": ("cos1_mm", "sin1_mm"),
    "linkage_coupling": ("coupling",),
}
BESIDE_THE_MACHINE = {
    "latency",
    "clock_drift",
    "station_scale",
    "prism_constant",
    "prism_incidence",
    "base_settlement",
    "base_step",
    "base_compliance",
    "base_shift",
    "measured_tilt",
}
FAMILIES = sorted(library().items())
ROWS = 40
TILTS = ("tilt_x_deg", "tilt_y_deg")  # what an inclinometer reads, signals of a rig file
UNKNOWN = 15  # of the rows of `lacking`, which lack all that is optional


def everything(rig: Rig, session: Observations) -> Observations:
    """Observations with every column that any effect needs."""
    n, rng = len(session), np.random.default_rng(9)
    extra = dict(session.extra)
    extra |= {f"{j.name}_rate": rng.uniform(-1.0, 1.0, n) * (0.05 * j.max_rate) for j in rig.joints}
    extra |= {f"{j.name}_bar": rng.uniform(20.0, 200.0, n) for j in rig.joints if j.kind == "prismatic"}
    extra["time_s"] = np.sort(rng.uniform(0.0, 4.0 * 3600.0, n))
    extra["temperature_degC"] = rng.uniform(-5.0, 25.0, n)
    extra |= {column: rng.uniform(-0.5, 0.5, n) for column in TILTS}
    extra["payload_kg"] = np.where(rng.random(n) < 0.5, 0.0, 300.0)
    return replace(session, extra=extra)


@pytest.fixture(scope="module")
def context(session: Session) -> EffectContext:
    return EffectContext(
        Chain(session.rig.with_signals(*TILTS), session.model.placements),
        session.model.values,
        everything(session.rig, session.held_out.select(np.arange(ROWS))),
    )


def forms(family: Family, context: EffectContext) -> Iterator[tuple[str, Settings]]:
    for where in family.places(context.rig):
        for settings in family.variants(context, where):
            yield where, settings


def moved_mm(context: EffectContext, choice: Choice) -> Floats:
    """(n, 3, k) by unit coefficients, in the station's frame."""
    return choice.columns(context).moved_mm(context.to_station(context.located.joint_jacobian))


def test_the_library_has_the_families_of_the_contract_and_every_file_is_one() -> None:
    assert REPORTED.keys() <= library().keys()
    assert not any(library()[name].moves_machine for name in BESIDE_THE_MACHINE)
    assert list(library()) == sorted(module.name for module in pkgutil.iter_modules(families.__path__))


@pytest.mark.parametrize(("name", "family"), FAMILIES)
def test_a_family_says_what_it_is_what_looks_like_it_and_what_shows_it(name: str, family: Family) -> None:
    assert family.name == name
    for text in (family.equation, family.source, family.revealed_by, type(family).__doc__ or ""):
        assert len(text) > 20
    assert family.confused_with
    assert set(family.confused_with) <= library().keys() - {name}


@pytest.mark.parametrize(("name", "family"), FAMILIES)
@pytest.mark.slow
def test_a_family_has_sane_numbers_wherever_it_may_be_on_the_boom(
    name: str, family: Family, context: EffectContext
) -> None:
    found = list(forms(family, context))
    assert found
    for where, settings in found:
        coefficients = family.coefficients(context, where, settings)
        assert tuple(c.name for c in coefficients) == family.names(settings)
        for c in coefficients:
            assert 0.0 < c.sigma < c.upper
            assert c.lower in (0.0, -c.upper)
            of, *per = (part.strip("()").split(" ")[0].split("^")[0] for part in c.unit.split("/"))
            assert of == "1" or of in c.name or (of, c.name) == ("s", "seconds")
            assert all(f"per_{part}" in c.name for part in per)
        fitted = tuple(FittedCoefficient(c.name, c.unit, c.sigma, 0.1 * c.sigma, c.sigma) for c in coefficients)
        reported = family.reported(settings, fitted)
        assert name not in REPORTED or tuple(c.name for c in reported) == REPORTED[name]
        assert all(np.isfinite([c.value, c.standard_error, c.prior_sigma]).all() for c in reported)
        sigma = np.array([c.sigma for c in coefficients])
        variance = family.unknown_variance(sigma, sigma, settings)
        assert 0.0 <= variance < np.inf
        assert Choice(name, where, settings).columns(context).column.dtype == np.float64
        # Plausible sizes are seen by an instrument of 0.01 mm, and no accident.
        moved = moved_mm(context, Choice(name, where, settings)) * sigma
        assert moved.shape == (ROWS, 3, len(coefficients))
        assert np.isfinite(moved).all()
        assert 1e-2 < np.abs(moved).max() < 300.0, (where, settings)


@pytest.mark.parametrize("family", library().values(), ids=list(library()))
def test_a_family_has_forms_where_a_spindle_turns_no_row(family: Family, context: EffectContext) -> None:
    rig = context.rig
    spindle = rig.joint("L3").model_copy(update={"kind": "revolute"})
    joints = tuple(spindle if joint.name == "L3" else joint for joint in rig.joints)
    chain = Chain(rig.model_copy(update={"joints": joints}), context.chain.placements)
    there = EffectContext(chain, context.x, context.observations)
    for where, settings in forms(family, there):
        assert np.isfinite(moved_mm(there, Choice(family.name, where, settings))).all()


@pytest.mark.parametrize("family", library().values(), ids=list(library()))
def test_columns_are_the_derivative_of_what_a_model_predicts(
    family: Family, context: EffectContext, session: Session
) -> None:
    """Finite differences through the whole prediction: units, couplings and frames."""
    observations, model = context.observations, session.model
    parameters = len(model.chain)
    for where in family.places(context.rig):
        for settings in family.variants(context, where)[:1]:
            choice = Choice(family.name, where, settings)
            coefficients = family.coefficients(context, where, settings)
            covariance = np.zeros((parameters + len(coefficients),) * 2)
            covariance[:parameters, :parameters] = model.covariance
            by_column = moved_mm(context, choice)
            for i, c in enumerate(coefficients):
                step = np.zeros(len(coefficients))
                step[i] = 0.1 * c.sigma
                ends = [
                    Predictor.of(
                        replace(
                            model, effects=(choice.fitted(context, sign * step, 0.0 * step),), covariance=covariance
                        )
                    ).effects_mm(observations)
                    for sign in (1.0, -1.0)
                ]
                difference = (ends[0] - ends[1]) / (2.0 * step[i])
                size = max(np.abs(by_column[:, :, i]).max(), 1e-6 / step[i])
                assert np.abs(difference - by_column[:, :, i]).max() < 2e-3 * size, (where, c.name)


@pytest.mark.parametrize(("name", "family"), FAMILIES)
def test_in_the_base_frame_a_model_has_what_the_machine_does_and_nothing_else(
    name: str, family: Family, context: EffectContext, session: Session
) -> None:
    """What fixes err by and how the base moves is in the station's frame alone; all other effects are in both."""
    observations, model = context.observations, session.model
    where = family.places(context.rig)[0]
    settings = next(settings for at, settings in forms(family, context) if at == where)
    sigma = np.array([c.sigma for c in family.coefficients(context, where, settings)])
    covariance = np.zeros((len(model.values) + len(sigma),) * 2)
    erring = replace(
        model, effects=(Choice(name, where, settings).fitted(context, sigma, 0.1 * sigma),), covariance=covariance
    )
    base = model.chain.base(model.values, 0)
    of_fixes = (Predictor.of(erring).effects_mm(observations) - base.translation_mm) @ base.rotation
    plain = (Predictor.of(model).effects_mm(observations) - base.translation_mm) @ base.rotation
    assert np.abs(of_fixes - plain).max() > 1e-2
    of_machine = of_fixes if family.moves_machine else plain
    np.testing.assert_allclose(Predictor.of(erring).base_mm(observations), of_machine, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("family", library().values(), ids=list(library()))
def test_a_family_does_nothing_where_what_it_needs_was_not_measured(family: Family, context: EffectContext) -> None:
    measured = np.arange(ROWS) >= UNKNOWN
    extra = {name: np.where(measured, v, np.nan) for name, v in context.observations.extra.items()}
    lacking = replace(context, observations=replace(context.observations, extra=extra))
    rig = context.rig.model_copy(update={"masses": ()})
    bare = EffectContext(Chain(rig, context.chain.placements), context.x, replace(context.observations, extra={}))
    for where in family.places(rig):
        # The path travelled is known from the order of rows none of which has a time.
        assert family.known(bare, where).all() == (not family.needs(where) or family.name == "transducer_cumulative")
        for settings in family.variants(context, where)[:1]:
            effect = Choice(family.name, where, settings).columns(lacking)
            of_rows = effect.column if effect.shift_mm is None else effect.shift_mm.reshape(ROWS, -1)
            assert np.isfinite(of_rows).all()
            assert not of_rows[~family.known(lacking, where)].any()


@pytest.mark.parametrize("family", library().values(), ids=list(library()))
def test_settings_of_another_family_are_refused(family: Family) -> None:
    with pytest.raises(ValueError, match="setting"):
        family.names({"surprise": 1.0})


@pytest.mark.parametrize("rig_name", ["swdt82", "ys100", "ur10"])
def test_every_family_copes_with_every_rig_and_with_a_single_row(rig_name: str) -> None:
    rig = shipped_rig(rig_name).with_signals(*TILTS)
    table = simulate_observations(RigTruth(rig, 5), 12, 1, prisms_per_pose="one", noise_mm=0.1)
    full = everything(rig, parse_observations(table.csv_text().encode(), rig, "simulated.csv"))
    chain = Chain(rig, {"": Placement.identity()})
    for rows in (full, full.select(np.arange(1)), replace(full, extra={})):
        context = EffectContext(chain, np.zeros(len(chain)), rows)
        for name, family in FAMILIES:
            for where, settings in forms(family, context):
                additions = Choice(name, where, settings).columns(context)
                assert additions.column.dtype == np.float64
                assert np.isfinite(additions.column).all()
                assert additions.shift_mm is None or np.isfinite(additions.shift_mm).all()


def test_places_and_names_that_do_not_exist_are_refused_in_a_sentence() -> None:
    rig = shipped_rig("swdt82")
    assert parse_effects("backlash@theta1, angle_scale@theta4", rig) == (
        ("backlash", "theta1"),
        ("angle_scale", "theta4"),
    )
    for text, message in (
        ("gremlins@theta1", f"effect 'gremlins' is unknown; there are {', '.join(library())}"),
        ("", "effect '' is unknown"),
        ("backlash@L2", "backlash@L2: backlash may be at theta1, theta3"),
        ("backlash", "backlash: backlash may be at theta1"),
        ("backlash@theta1,backlash@theta1", "named twice"),
    ):
        with pytest.raises(ValueError, match=message):
            parse_effects(text, rig)


def test_an_effect_of_a_joint_is_at_joints_of_its_kind() -> None:
    rig = shipped_rig("swdt82")
    for family in library().values():
        if isinstance(family, JointFamily):
            assert {rig.joint(where).kind for where in family.places(rig)} == {family.kind}
