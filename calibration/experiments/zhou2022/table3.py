"""Table 3: the data and weights that identify the rows' constants best, by the paper's search and by a converged fit.

The paper's values may depend on where its search stopped rather than on physics. The same objective, unknowns and
bounds are therefore solved twice: by the paper's search and to convergence. As in the paper, base and unknown prism
offsets are assumed known: they keep the values of the nominal model. As in Eq. 19 of the paper, only the four
positions are weighted, without the attitude that `first_paper` adds if two prisms of one frame determine it. A third
solution also searches base and offsets. It shows the cost of a fixed base if the nominal values are far off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.experiments.zhou2022.weights import Front, WeightedSquares, pareto_front
from calibration.identification.refinement import Prior, refine
from calibration.identification.samples import Samples
from calibration.identification.solve import place
from calibration.observations import Floats, Observations
from calibration.published.first_paper import bounds, search
from calibration.published.paper_evolution import PaperSettings
from calibration.published.paper_objective import PaperObjective
from calibration.residual.folds import folds
from calibration.rig.description import Rig
from calibration.run_settings import Run

Flags = NDArray[np.bool_]
DataSet = Literal["single-joint", "multi-joint", "weighted"]
Way = Literal["paper", "converged", "base free"]

# Mean absolute errors in mm that the paper reports for its own machine.
PAPER_AFTER: Mapping[DataSet, Mapping[str, float]] = {
    "single-joint": {"r": 382.58, "s": 396.04, "b": 466.92, "w": 263.21},
    "multi-joint": {"r": 389.08, "s": 334.58, "b": 290.45, "w": 44.83},
    "weighted": {"r": 306.82, "s": 320.12, "b": 298.69, "w": 70.37},
}
_FOLDS = 3  # one of them evaluates the weights
_AT_BOUND = 0.999


@dataclass(frozen=True)
class Identified:
    """One line of the table.

    Attributes:
        data: the training rows that were used.
        way: the paper's search, the converged optimum, or the optimum with free base and unknown prism offsets.
        weight: mu of every prism.
        fixes: number of different fixes that were fitted.
        objective_mm2: value of Eq. 19 on these fixes.
        held_out_mm: prism -> mean error on the held-out rows.
        at_bounds: number of parameters that ended at their bounds.
        seconds: duration.
        complete: False if the search was stopped before its end.
    """

    data: DataSet
    way: Way
    weight: Mapping[str, float]
    fixes: int
    objective_mm2: float
    held_out_mm: Mapping[str, float]
    at_bounds: int
    seconds: float
    complete: bool

    def as_dict(self) -> dict[str, object]:
        """Return a JSON object of the line."""
        return {
            "data": self.data,
            "search": self.way,
            "weights": dict(self.weight),
            "fixes": self.fixes,
            "objective_mm2": self.objective_mm2,
            "holdout_mean_mm": dict(self.held_out_mm),
            "parameters_at_bounds": self.at_bounds,
            "complete": self.complete,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, eq=False)
class Table3:
    """Table 3's data, bound to one chain.

    Attributes:
        samples: training rows, with repeats averaged.
        training, held_out: the objective on the training and on the held-out rows.
        single: (m,) mask of samples of single-joint motion.
    """

    samples: Samples
    training: WeightedSquares
    held_out: WeightedSquares
    single: Flags

    @classmethod
    def prepare(cls, rig: Rig, training: Observations, held_out: Observations, single: Flags, prior: Prior) -> Table3:
        """Place the base with the nominal model, and set the bounds of the rows' constants.

        Args:
            rig: the rig description.
            training: n rows.
            held_out: rows of the same set-ups.
            single: (n,) mask of rows of single-joint motion.
            prior: determines the width of the bounds.

        Raises:
            DataError, UnsafeError: as for `solve.place`.
        """
        chain, samples, start = place(rig, training)
        nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
        free = np.array([p.kind == "row" for p in chain.parameters])
        width = bounds(chain, prior)[free]
        fitted = WeightedSquares(chain, samples.data, samples.position_mm, free, nominal.x, width)
        judged = WeightedSquares(chain, chain.bind(held_out), held_out.position_mm, free, nominal.x, width)
        swept = np.zeros(len(samples), dtype=bool)
        swept[samples.of_row[single]] = True
        return cls(samples, fitted, judged, swept)

    def front(self, run: Run) -> Front | None:
        """Return the Pareto front, fitted on two thirds of the training poses and evaluated on the others.

        With fewer than two prisms, return None.
        """
        if len(self.training.prisms) < 2:
            return None
        fold = folds(np.char.add("pose ", self._pose), _FOLDS, run.seed)
        return pareto_front(self.training.select(fold != 0), self.training.select(fold == 0), run)

    def data_sets(self, front: Front | None) -> list[tuple[DataSet, Flags, dict[str, float]]]:
        """Return name, mask of samples, and weights of every line.

        The weighted line has all samples and the weights of the front.
        """
        equal = dict.fromkeys(self.training.prisms, 1.0 / len(self.training.prisms))
        sets: list[tuple[DataSet, Flags, dict[str, float]]] = []
        if self.single.any():
            sets.append(("single-joint", self.single, equal))
        if not self.single.all():
            sets.append(("multi-joint", ~self.single, equal))
        if front is not None:
            sets.append(("weighted", np.ones(len(self.samples), dtype=bool), front.weight))
        return sets

    def enough(self, rows: Flags) -> bool:
        """Return True if there are at least as many coordinates as unknowns."""
        return 3 * int(rows.sum()) >= int(self.training.free.sum())

    def identify(
        self,
        data: DataSet,
        rows: Flags,
        weight: Mapping[str, float],
        *,
        run: Run,
        clock: Callable[[], float],
        settings: PaperSettings | None,
        time_limit_s: float | None,
    ) -> tuple[Identified, ...]:
        """Return the lines of the paper's search, of the converged optimum, and of the optimum with a free base.

        Args:
            data: name of one of `data_sets`.
            rows: (m,) mask of its samples.
            weight: its weights.
            run: seed, workers and progress of the search.
            settings: settings of the search.
            clock: function that returns monotonic seconds.
            time_limit_s: time limit of the search.
        """
        part = self.training.select(rows)
        given = {name: mu for name, mu in weight.items() if name in part.prisms}
        objective = PaperObjective(
            part.chain, part.data, part.position_mm, self._pose[rows], given, free=part.free, at=part.at
        )
        began = clock()
        evolved = search(
            objective,
            part.width,
            run=replace(run, should_stop=lambda: time_limit_s is not None and clock() - began > time_limit_s),
            settings=settings,
        )
        searched = clock()
        optimum = part.optimum(given)
        solved = clock()
        released = part.with_base().optimum(given)
        found: tuple[tuple[Way, WeightedSquares, Floats, float, bool], ...] = (
            ("paper", part, evolved.x, searched - began, evolved.complete),
            ("converged", part, optimum, solved - searched, True),
            ("base free", part.with_base(), released, clock() - solved, True),
        )
        return tuple(
            Identified(
                data,
                way,
                given,
                len(part.data),
                problem.cost(given, x),
                self.held_out_mean_mm(problem.values(x)),
                int((np.abs(x) > _AT_BOUND * problem.width).sum()),
                round(seconds, 3),
                complete,
            )
            for way, problem, x, seconds, complete in found
        )

    def held_out_mean_mm(self, values: Floats | None = None) -> dict[str, float]:
        """Return prism -> mean error on the held-out rows.

        Args:
            values: (p,) all parameters; those of the nominal model by default.
        """
        judged = self.held_out
        position = judged.chain.positions_mm(judged.at if values is None else values, judged.data)
        error, prism = np.linalg.norm(judged.position_mm - position, axis=1), judged.data.prism
        names = judged.chain.rig.prism_names
        return {names[i]: float(error[prism == i].mean()) for i in np.unique(prism)}

    @property
    def _pose(self) -> np.ndarray[tuple[int, ...], np.dtype[np.str_]]:
        """(m,) labels of the samples' standstills."""
        standstill = self.samples.standstill
        return np.asarray(np.arange(len(self.samples)) if standstill is None else standstill).astype(np.str_)
