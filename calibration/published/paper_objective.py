"""The first paper's objective: weighted mean squared errors of the prisms, Eq. 19, with the attitude of Eqs. 4 and 5.

F = sum over prisms mu_p e_p^2 / n_p + mu_delta e_delta^2 / n_delta. The attitude of the end is the direction from one
of two prisms to the other. Its error e_delta is therefore the difference of their position errors (mm, at the distance
between them), without errors common to both. The position of the end, e_d, is the part of these prisms in the sum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError
from calibration.kinematics.chain import Chain, ChainData
from calibration.kinematics.fitness import Fitness
from calibration.observations import Floats

Integers = NDArray[np.intp]


@dataclass(frozen=True)
class PaperObjective:
    """Objective of Eq. 19 on a data set or on parts of it.

    Attributes:
        chain: kinematics.
        data: (n) bound observations.
        position_mm: (n, 3) measured positions.
        pose: (n,) label of the standstill, unique over sessions and set-ups; fixes with the same label belong together,
            and a fix with an empty label belongs to no other fix.
        weight: name of a prism -> mu; a prism that is missing here is not used.
        attitude: the two prisms that give the end's attitude; None to leave the attitude out.
        attitude_weight: mu_delta.
        free: (p,) mask of the parameters that are searched; all by default.
        at: (p,) values of the other parameters; zero by default.
    """

    chain: Chain
    data: ChainData
    position_mm: Floats
    pose: NDArray[np.str_]
    weight: Mapping[str, float]
    attitude: tuple[str, str] | None = None
    attitude_weight: float = 1.0
    free: NDArray[np.bool_] | None = None
    at: Floats | None = None

    def fitness(self, rows: Integers | None = None) -> Fitness:
        """Return the objective on the given rows, a function of (candidates, free parameters).

        Args:
            rows: indices of rows; all by default.

        Raises:
            DataError: a weighted prism without a fix, or no pose with both prisms of the attitude.
        """
        rows = np.arange(len(self.data)) if rows is None else rows
        data = self.data.select(rows)
        weight = np.zeros(len(rows))
        for name, mu in self.weight.items():
            own = data.prism == self._index(name)
            if not own.any():
                raise DataError("observations", f"prism {name!r} has weight {mu:g} in the objective but no fix")
            weight[own] = mu / own.sum()
        pairs, pair_weight = None, None
        if self.attitude is not None:
            pairs = self._pairs(self.attitude, data, self.pose[rows])
            if len(pairs) == 0:
                both = " and ".join(map(repr, self.attitude))
                raise DataError("observations", f"no pose has fixes of both {both}; the attitude needs one")
            pair_weight = np.full(len(pairs), self.attitude_weight / len(pairs))
        return Fitness.build(
            self.chain,
            data,
            self.position_mm[rows],
            weight,
            free=self.free,
            at=self.at,
            pairs=pairs,
            pair_weight=pair_weight,
        )

    def shuffled(self, repeats: int, share: float, seed: int) -> list[Integers]:
        """Return the rows of a random part of the data for each repeat of the search.

        "The data set is shuffled and the search repeated": the order of terms does not change a sum, so a shuffle can
        only mean that each search uses different data. The poses are shuffled and the first `share` of them is used, at
        least one; fixes of one pose stay together. If a prism or the attitude then has no data, the next pose that has
        such data is added.

        Args:
            repeats: number of parts.
            share: share of the poses, above 0 and at most 1.
            seed: the same seed draws the same parts.
        """
        alone = np.char.add("row ", np.arange(len(self.pose)).astype(str))
        label = np.where(self.pose == "", alone, np.char.add("pose ", self.pose))
        _, group = np.unique(label, return_inverse=True)
        generator = np.random.default_rng(seed)
        poses = int(group.max()) + 1
        needed = [group[self.data.prism == self._index(name)] for name in self.weight]
        if self.attitude is not None:
            needed.append(group[self._pairs(self.attitude, self.data, self.pose)[:, 0]])
        parts = []
        for _ in range(repeats):
            order = generator.permutation(poses)
            taken = order[: max(1, round(share * poses))]
            for groups in needed:
                if not np.isin(groups, taken).any():
                    taken = np.append(taken, order[np.isin(order, groups)][:1])
            parts.append(np.flatnonzero(np.isin(group, taken)))
        return parts

    def _index(self, name: str) -> int:
        names = self.chain.rig.prism_names
        if name not in names:
            raise DataError("objective", f"the rig has no prism {name!r}; it has {', '.join(map(repr, names))}")
        return names.index(name)

    def _pairs(self, prisms: tuple[str, str], data: ChainData, pose: NDArray[np.str_]) -> Integers:
        """Return (k, 2) rows of the two prisms, one pair for every pose that has both."""
        first, second = (
            {pose[row]: int(row) for row in np.flatnonzero((data.prism == self._index(name)) & (pose != ""))}
            for name in prisms
        )
        pairs = [(row, second[label]) for label, row in first.items() if label in second]
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)
