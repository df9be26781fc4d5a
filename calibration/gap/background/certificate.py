"""Certificates: an effect that one half of the data selects is tested on the other half.

The search uses all data, so its evidence is not an independent test. Here the data are split by groups. One half
selects the effect of greatest evidence given all others. If this is the named effect, the other half tests it with an
F-test, which is exact for normal errors and any number of rows, with kinematics and background at their priors as part
of the error. Both halves take both roles, and the p-value is corrected for that. The p-values of all names are then
adjusted for the false discovery rate (Benjamini and Hochberg 1995). Sample splitting: Cox, Biometrika 62, 1975.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import fdtrc

from calibration.gap.background.system import Chosen, Model, System
from calibration.gap.projected.projection import rows_of
from calibration.observations import Floats


def certificates(system: System, model: Model, places: Sequence[set[str]], seed: int) -> Floats:
    """Return the p-value (e,) of every effect of a model; 1 where neither half selects it.

    Args:
        system: the linear model.
        model: a model with e effects.
        places: possible places of each effect; selecting any of them counts as selecting the effect.
        seed: random seed of the split.
    """
    labels, group = np.unique(system.projection.groups, return_inverse=True)
    first = np.isin(group, np.random.default_rng([seed, 3]).permutation(len(labels))[: len(labels) // 2])
    halves = [system.of_rows(rows_of(np.flatnonzero(own))) for own in (first, ~first)]
    p = np.ones(len(model.effects))
    for number, effect in enumerate(model.effects):
        without = system.fit(model.without(number), model.scales)
        family = system.candidates[effect[0]].family
        for choosing, testing in (halves, halves[::-1]):
            best = max(choosing.screen(without).score(), key=lambda w: w.log_bayes_factor)
            if best.candidate.family == family and best.candidate.where in places[number]:
                p[number] = min(p[number], 2.0 * _f_test(testing, without, system.choice(best)))
    return _adjusted(p)


def _f_test(system: System, model: Model, effect: Chosen) -> float:
    """Return the p-value of adding an effect to a model, for rows that were not used to select it.

    It is 1 if these rows cannot show the effect, as where all of them were measured after a jump.
    """
    squares, columns, total = system.explained(model, effect)
    if columns == 0:
        return 1.0
    rest = system.products.rows - columns
    return float(fdtrc(columns, rest, (squares / columns) / ((total - squares) / rest)))


def _adjusted(p: Floats) -> Floats:
    """Return p-values (e,) adjusted for the false discovery rate."""
    order = np.argsort(p)
    ranked = p[order] * len(p) / np.arange(1, len(p) + 1)
    out = np.empty_like(p)
    out[order] = np.minimum(np.minimum.accumulate(ranked[::-1])[::-1], 1.0)
    return out
