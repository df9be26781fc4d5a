"""A case with its label and its answer, and their comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from daemon.benchmark.regime import TrueRegime, regime_of

Floats = NDArray[np.float64]

HALF_90 = 1.645  # half width of a 90 % interval, in standard errors
_TOLD_APART = 5.0  # log odds below which families are reported as a set
_SHOWS = 1.02  # there is no gap to close if the held-out error of kinematics is below this multiple of the oracle's


@dataclass(frozen=True)
class TrueEffect:
    """A hidden effect.

    Attributes:
        family, where: its family and place.
        has_name: whether the library has it.
        places: places that count as its location.
        coefficients: name -> true value of the coefficients of the library's family.
        scale: name -> plausible size, for comparing coefficients of different units.
        separable: whether the data distinguish it from all other effects and places, given the other hidden effects.
    """

    family: str
    where: str
    has_name: bool
    places: tuple[str, ...]
    coefficients: Mapping[str, float]
    scale: Mapping[str, float]
    separable: bool


@dataclass(frozen=True)
class Trial:
    """A case.

    Attributes:
        case: name of the case.
        kind: kind of case, as in `docs/explanation/gap-benchmark.md`.
        poses, noise, size: its cell; size is the visible RMS of an effect in units of the noise.
        seed: seed that draws this case.
        effects: hidden effects.
        separable: whether the data distinguish the effect from all alternatives in all but 2 % of the noise draws.
        plain: the same in all but 0.1 % of the noise draws, so that noise does not excuse a set instead of a name.
        alternative: the nearest alternative, `family@where`.
        general: families that also describe the hidden effect although they differ from its own.
        aliases: families that the data cannot distinguish by construction; empty if there are none.
        regime: the part of the data in which the hidden effect acts; None for all rows.
        answer: answer of the workflow.
        measured: answer after the proposed poses were measured; None if they were not.
        truth_mm: (m, 3) noise-free held-out positions.
        oracle_mm2: mean squared 3-D error on held-out poses of the twin without effects, of kinematics fitted to the
            twin; None if there is no twin.
    """

    case: str
    kind: str
    poses: str
    noise: str
    size: float
    seed: int
    effects: tuple[TrueEffect, ...]
    separable: bool
    plain: bool
    alternative: str
    general: frozenset[str]
    aliases: tuple[str, ...]
    regime: TrueRegime | None
    answer: Mapping[str, Any]
    measured: Mapping[str, Any] | None
    truth_mm: Floats
    oracle_mm2: float | None

    @property
    def verdict(self) -> str:
        return str(self.answer["verdict"])

    @property
    def families(self) -> frozenset[str]:
        """Families of those hidden effects that the library has."""
        return frozenset(effect.family for effect in self.effects if effect.has_name)

    @property
    def named(self) -> frozenset[str]:
        """Families that were adopted."""
        return frozenset(effect["family"] for effect in self.answer.get("effects", ()))

    @property
    def _named_places(self) -> frozenset[tuple[str, str]]:
        """(family, place) of each effect that was adopted."""
        return frozenset((effect["family"], effect["where"]) for effect in self.answer.get("effects", ()))

    @property
    def reported_set(self) -> frozenset[str]:
        """Families of the pending set."""
        return frozenset(candidate["family"] for candidate in self.answer.get("indistinguishable", ()))

    @property
    def is_right(self) -> bool:
        """True if exactly the hidden families of the library are named, in their part of the data."""
        is_whole = self.regime is None or self.is_border_right
        return self.verdict == "named" and self.named == self.families and is_whole

    @property
    def is_in_place(self) -> bool:
        """True if exactly the right families are named, each at its place and none in a wrong part of the data."""
        true = {(e.family, e.where) for e in self.effects if e.has_name}
        return self.is_right and self._named_places == true and not any(self.names_told)

    @property
    def is_wrong(self) -> bool:
        """True if a family is named that is neither hidden nor also describes a hidden effect."""
        return bool(self.named - self.families - self.general)

    @property
    def effects_told(self) -> list[tuple[TrueEffect, bool]]:
        """Hidden effects of the library, each with a flag: True if it is named at its place."""
        return [(e, (e.family, e.where) in self._named_places) for e in self.effects if e.has_name]

    @property
    def names_told(self) -> list[bool]:
        """For each named effect, True if it is wrong: neither hidden at that place nor describing what is hidden."""
        true = {(e.family, e.where) for e in self.effects}
        return [
            family not in self.general and ((family, where) not in true or self._is_in_false_part(family, where))
            for family, where in self._named_places
        ]

    @property
    def told_regime(self) -> Mapping[str, Any] | None:
        """Regime of the hidden effect in the answer; None if the effect is not named or acts in all rows."""
        for told in self.answer.get("effects", ()):
            if any((told["family"], told["where"]) == (e.family, e.where) for e in self.effects):
                return regime_of(told)
        return None

    @property
    def is_regime_named(self) -> bool:
        """True if the hidden effect is named at its place and in its part of the data, with any border."""
        return self.regime is not None and self.regime.is_part(self.told_regime)

    @property
    def is_border_right(self) -> bool:
        """True if the named border is within 10 % of its variable's range."""
        return self.regime is not None and self.regime.is_border(self.told_regime)

    def _is_in_false_part(self, family: str, where: str) -> bool:
        """Return True if an effect is named in a part of the data other than the true one."""
        told = next(e for e in self.answer["effects"] if (e["family"], e["where"]) == (family, where))
        part = regime_of(told)
        return part is not None and not (self.regime is not None and self.regime.is_part(part))

    @property
    def is_set_true(self) -> bool:
        """True if the pending set has at most three families, among them all hidden families that are not adopted."""
        return len(self.reported_set) <= 3 and self.families - self.named <= self.reported_set

    @property
    def is_located(self) -> bool:
        """True if the first place in the answer is a place of a hidden effect."""
        told = [*self.answer.get("effects", ()), *self.answer.get("disagreements", ())]
        said = [told[0]["where"]] if told else []
        description = str(self.answer.get("description") or "")
        if description and not self.named:
            said = description.partition("=")[0].split()  # as in `theta4 angle error = ...`
        return any(word in effect.places for effect in self.effects for word in said)

    @property
    def outcome(self) -> str:
        """`right`, `part`, `wrong`, `set`, or the verdict."""
        if self.is_wrong:
            return "wrong"
        if self.verdict == "named":
            return "right" if self.is_right else "part"
        return {"indistinguishable": "set"}.get(self.verdict, self.verdict)

    @property
    def is_resolved(self) -> bool:
        """True if the answer after the proposed poses names exactly the hidden families."""
        told = self.measured or {"verdict": "", "effects": ()}
        return told["verdict"] == "named" and {effect["family"] for effect in told["effects"]} == self.families

    @property
    def is_promised(self) -> bool:
        """True if the proposed poses were expected to distinguish all families of the set."""
        promised = [e["stands_out_sigma"] for e in self.answer.get("experiments", ()) if "poses" in e]
        return bool(promised) and all(0.5 * sigma**2 >= _TOLD_APART for each in promised for sigma in each.values())

    @property
    def held_out_mm2(self) -> tuple[float, float] | None:
        """Mean squared 3-D error on held-out poses without and with the effects, mm2; None if the case failed."""
        if "after_mm" not in self.answer:
            return None
        before, after = (mean_square_mm2(self.answer[name], self.truth_mm) for name in ("before_mm", "after_mm"))
        return before, after

    @property
    def is_held_out_raised(self) -> bool:
        """True if the effects increase the held-out error."""
        held_out = self.held_out_mm2
        return held_out is not None and held_out[1] > held_out[0]

    @property
    def closed(self) -> float | None:
        """Share of the held-out gap that was closed; None if there is no gap or no oracle."""
        held_out = self.held_out_mm2
        if self.oracle_mm2 is None or held_out is None:
            return None
        before, after = held_out
        if before <= _SHOWS**2 * self.oracle_mm2:
            return None
        return (before - after) / (before - self.oracle_mm2)

    def coefficient_errors(self) -> tuple[float, list[bool]]:
        """Compare the coefficients of effects that are named at the right place with the true values.

        Returns:
            The relative error over all coefficients, and for each coefficient True if its 90 % interval contains the
            true value. Coefficients without a standard error are skipped.
        """
        inside: list[bool] = []
        error, size = 0.0, 0.0
        for told in self.answer["effects"]:
            true = next(e for e in self.effects if (e.family, e.where) == (told["family"], told["where"]))
            for name, value in true.coefficients.items():
                found = told["coefficients"].get(name)
                if found is None or not found["standard_error"]:
                    continue
                missed = float(found["value"]) - value
                inside.append(abs(missed) <= HALF_90 * float(found["standard_error"]))
                error += (missed / true.scale[name]) ** 2
                size += (value / true.scale[name]) ** 2
        return (float(np.sqrt(error / size)) if size else float("nan")), inside


def mean_square_mm2(predicted_mm: ArrayLike, true_mm: ArrayLike) -> float:
    """Return the mean squared 3-D error of positions (m, 3), mm2."""
    error = np.asarray(predicted_mm, dtype=float) - np.asarray(true_mm, dtype=float)
    return float(np.mean(np.sum(error**2, axis=1)))


def trial(
    label: Mapping[str, Any],
    answer: Mapping[str, Any],
    measured: Mapping[str, Any] | None,
    oracle: Mapping[str, Any] | None,
) -> Trial:
    """Join a label with the answers to its case and to its twin.

    Args:
        label: as in the file of labels.
        answer: answer to the case.
        measured: answer after the proposed poses were measured; None if they were not.
        oracle: answer of `analyse.oracle` on the twin; None if there is no twin.
    """
    effects = tuple(
        TrueEffect(
            e["family"], e["where"], e["has_name"], tuple(e["places"]), e["coefficients"], e["scale"], e["separable"]
        )
        for e in label["effects"]
    )
    return Trial(
        case=label["case"],
        kind=label["kind"],
        poses=label["poses"],
        noise=label["noise"],
        size=label["size"],
        seed=label["seed"],
        effects=effects,
        separable=label["separable"],
        plain=label["plain"],
        alternative=label["alternative"],
        general=frozenset(label["general"]),
        aliases=tuple(label["aliases"]),
        regime=None if label["regime"] is None else TrueRegime(**label["regime"]),
        answer=answer,
        measured=measured,
        truth_mm=np.asarray(label["truth_mm"], dtype=float),
        oracle_mm2=None if oracle is None else mean_square_mm2(oracle["oracle_mm"], label["twin_mm"]),
    )
