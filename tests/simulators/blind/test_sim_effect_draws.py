"""Effects that are asked for have sizes that a machine of the rig can have."""

from __future__ import annotations

import pytest

from calibration.rig.description import Rig, shipped_rig
from simulators.blind.effect_draws import EffectDraws, require_plausible
from simulators.effects.library import FAMILIES, parse_effects


@pytest.mark.parametrize("name", ["swdt82", "ur10"])
def test_every_effect_of_its_usual_size_is_taken_and_any_far_larger_one_refused(name: str) -> None:
    rig = shipped_rig(name)
    draws = EffectDraws(rig, rig.prism_names, 0.0, 0.0, 0.0)
    for family, kind in FAMILIES.items():
        for where in draws.places(family):
            require_plausible(rig, [kind(where=where)])
            for coefficient in kind.amplitudes:
                effect = parse_effects(f"{family}@{where}:{coefficient}=-1e30")
                with pytest.raises(
                    ValueError, match=rf"{family}@{where}: {coefficient}=-1e\+30 is beyond [\d.e+-]+, the"
                ):
                    require_plausible(rig, effect)


def test_the_limit_that_is_told_is_taken(swdt82: Rig) -> None:
    text = "joint_compliance@theta1:compliance_rad_per_Nm={}"  # a vertical axis: gravity loads it next to not at all
    with pytest.raises(ValueError, match="is beyond") as refused:
        require_plausible(swdt82, parse_effects(text.format(1.0)))
    limit = str(refused.value).split("beyond ")[1].split(",")[0]
    assert 0.0 < float(limit) < 1e-5
    require_plausible(swdt82, parse_effects(text.format(limit)))
    require_plausible(swdt82, parse_effects(text.format(0.0)))


@pytest.mark.parametrize("text", ["encoder_harmonic@theta1:k=1e30", "encoder_harmonic@theta1:k=2.5"])
def test_a_number_of_cycles_is_a_whole_one(text: str) -> None:
    with pytest.raises(ValueError, match="is not a whole number up to"):
        parse_effects(text)
