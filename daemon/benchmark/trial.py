"""A case with its label and its answer, and the comparison of the two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from daemon.benchmark.regime import TrueRegime, regime_of

Floats = NDArray[np.float64]

HALF_90 = 1.645  # half width of a 90 % interval, standard errors
_TOLD_APART = 5.0  # log odds: nearer families are a set
_SHOWS = 1.02  # an effect that makes held-out errors of kinematics smaller than this many oracles' is no gap to close


@dataclass(frozen=True)
class TrueEffect:
    """A hidden effect.

    Attributes:
        family, where: which.
        has_name: whether the library has it.
        places: that count as where it is.
        coefficients: name -> value, those that the library's family has.
        scale: name -> plausible size, for comparing coefficients of different units.
        separable: these data tell it from all other effects and places beside the other hidden ones.
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
        kind: a kind of case, as in `docs/explanation/gap-benchmark.md`.
        poses, noise, size: its cell; size is the visible RMS of an effect in units of the noise.
        seed: draws it again.
        effects: hidden effects.
        separable: this data tells the one effect from all alternatives in all but 2 % of the draws of the noise.
        plain: the same in all but 0.1 %: a set in its place is no matter of the draw.
        alternative: `family@where` nearest to it.
        general: families that are true of the hidden effect although it has another name.
        aliases: families that this data cannot tell apart by construction; empty where there are none.
        regime: the part of the data in which the hidden effect acts; None for all rows.
        answer: the workflow's.
        measured: its answer after the poses it proposed; None where it proposed none.
        truth_mm: (m, 3) noise-free held-out positions.
        oracle_mm2: mean squared 3-D error, on held-out poses of the twin without effects, of kinematics that were
            fitted to it; None where there is no twin.
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
        """Families of the hidden effects that the library has."""
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
        """Families of the set that is pending."""
        return frozenset(candidate["family"] for candidate in self.answer.get("indistinguishable", ()))

    @property
    def is_right(self) -> bool:
        """True if all hidden families of the library are named, in their part of the data, and no other."""
        is_whole = self.regime is None or self.is_border_right
        return self.verdict == "named" and self.named == self.families and is_whole

    @property
    def is_in_place(self) -> bool:
        """True if the right families are named at the right places, none of them in a false part, and no others."""
        true = {(e.family, e.where) for e in self.effects if e.has_name}
        return self.is_right and self._named_places == true and not any(self.names_told)

    @property
    def is_wrong(self) -> bool:
        """True if a family is named that is not hidden, nor true of what is."""
        return bool(self.named - self.families - self.general)

    @property
    def effects_told(self) -> list[tuple[TrueEffect, bool]]:
        """Hidden effects of the library, each with whether it is named at its place."""
        return [(e, (e.family, e.where) in self._named_places) for e in self.effects if e.has_name]

    @property
    def names_told(self) -> list[bool]:
        """True for each name that is wrong: nothing of that family is hidden at that place, nor true of what is."""
        true = {(e.family, e.where) for e in self.effects}
        return [
            family not in self.general and ((family, where) not in true or self._is_in_false_part(family, where))
            for family, where in self._named_places
        ]

    @property
    def told_regime(self) -> Mapping[str, Any] | None:
        """The part of the data in which the hidden effect acts by the answer; None if it is not named so."""
        for told in self.answer.get("effects", ()):
            if any((told["family"], told["where"]) == (e.family, e.where) for e in self.effects):
                return regime_of(told)
        return None

    @property
    def is_regime_named(self) -> bool:
        """True if the hidden effect is named at its place and in its part, whatever the border."""
        return self.regime is not None and self.regime.is_part(self.told_regime)

    @property
    def is_border_right(self) -> bool:
        """True if the named border is within 10 % of its variable's range."""
        return self.regime is not None and self.regime.is_border(self.told_regime)

    def _is_in_false_part(self, family: str, where: str) -> bool:
        """True if an effect is named for a part of the data that is not the one in which it acts."""
        told = next(e for e in self.answer["effects"] if (e["family"], e["where"]) == (family, where))
        part = regime_of(told)
        return part is not None and not (self.regime is not None and self.regime.is_part(part))

    @property
    def is_set_true(self) -> bool:
        """True if the pending set holds all hidden families that are not adopted, and at most three families."""
        return len(self.reported_set) <= 3 and self.families - self.named <= self.reported_set

    @property
    def is_located(self) -> bool:
        """True if the first place that the answer names is a place of a hidden effect."""
        told = [*self.answer.get("effects", ()), *self.answer.get("disagreements", ())]
        said = [told[0]["where"]] if told else []
        description = str(self.answer.get("description") or "")
        if description and not self.named:
            said = description.partition("=")[0].split()  # as in `theta4 angle error = ...`
        return any(word in effect.places for effect in self.effects for word in said)

    @property
    def outcome(self) -> str:
        """One word: `right`, `part`, `wrong`, `set`, or the verdict."""
        if self.is_wrong:
            return "wrong"
        if self.verdict == "named":
            return "right" if self.is_right else "part"
        return {"indistinguishable": "set"}.get(self.verdict, self.verdict)

    @property
    def is_resolved(self) -> bool:
        """True if the answer after the proposed poses names all hidden families and no other."""
        told = self.measured or {"verdict": "", "effects": ()}
        return told["verdict"] == "named" and {effect["family"] for effect in told["effects"]} == self.families

    @property
    def is_promised(self) -> bool:
        """True if the proposed poses were expected to tell all families of the set apart."""
        promised = [e["stands_out_sigma"] for e in self.answer.get("experiments", ()) if "poses" in e]
        return bool(promised) and all(0.5 * sigma**2 >= _TOLD_APART for each in promised for sigma in each.values())

    @property
    def held_out_mm2(self) -> tuple[float, float] | None:
        """Mean squared 3-D error on held-out poses without and with the effects; None of a case that failed."""
        if "after_mm" not in self.answer:
            return None
        before, after = (mean_square_mm2(self.answer[name], self.truth_mm) for name in ("before_mm", "after_mm"))
        return before, after

    @property
    def is_held_out_raised(self) -> bool:
        """True if the effects make the held-out error larger."""
        held_out = self.held_out_mm2
        return held_out is not None and held_out[1] > held_out[0]

    @property
    def closed(self) -> float | None:
        """Share of the held-out gap that was closed; None if there is no gap, or no oracle."""
        held_out = self.held_out_mm2
        if self.oracle_mm2 is None or held_out is None:
            return None
        before, after = held_out
        if before <= _SHOWS**2 * self.oracle_mm2:
            return None
        return (before - after) / (before - self.oracle_mm2)

    def coefficient_errors(self) -> tuple[float, list[bool]]:
        """Compare the coefficients of effects that are named right and in place with the true ones.

        Returns:
            The relative error over all coefficients, and for each one True if its 90 % interval holds the true value.
            Coefficients that are reported without a standard error count in neither.
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
    """Mean squared 3-D error of positions (m, 3)."""
    error = np.asarray(predicted_mm, dtype=float) - np.asarray(true_mm, dtype=float)
    return float(np.mean(np.sum(error**2, axis=1)))


def trial(
    label: Mapping[str, Any],
    answer: Mapping[str, Any],
    measured: Mapping[str, Any] | None,
    oracle: Mapping[str, Any] | None,
) -> Trial:
    """Return a label, as the file of labels has it, joined with the answers of its case and of its twin."""
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
