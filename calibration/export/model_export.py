"""The code that export formats share, and the error due to the parts of the model that a format leaves out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from calibration.design.knowledge import setup_of
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.export.correction_grid import CorrectionGrid, Machine, correction_grid, interpolated, trained_ranges
from calibration.kinematics.chain import Chain
from calibration.model.model import CalibratedModel
from calibration.observations import Floats

GRID_FILE = "corrections.csv"
_POSES = 1000
_SEED = 0


@dataclass(frozen=True)
class LeftOut:
    """The parts of the model that an export leaves out, and the resulting error.

    Attributes:
        parts: phrases, such as `joint_compliance@q2`; empty if nothing is left out.
        not_measured: sentences about parts whose error does not depend on joint values alone.
        rms_mm, p95_mm, max_mm: resulting error of the export over the work volume, all prisms together.
        correction_rms_mm: RMS size of the model's whole correction of the nominal positions there.
    """

    parts: tuple[str, ...]
    not_measured: tuple[str, ...] = ()
    rms_mm: float = 0.0
    p95_mm: float = 0.0
    max_mm: float = 0.0
    correction_rms_mm: float = 0.0

    @classmethod
    def of(cls, parts: Sequence[str], told: Sequence[str], off_mm: Floats, correction_mm: Floats) -> LeftOut:
        """Return the parts left out with their errors.

        Args:
            parts: the attribute `parts`.
            told: the attribute `not_measured`.
            off_mm: (n, 3) difference between export and model at poses of the work volume.
            correction_mm: (n, 3) difference between model and nominal positions at the same poses.
        """
        size_mm = np.linalg.norm(off_mm, axis=1)
        return cls(
            tuple(parts),
            tuple(told),
            float(np.sqrt((size_mm**2).mean())),
            float(np.quantile(size_mm, 0.95)),
            float(size_mm.max()),
            float(np.sqrt((correction_mm**2).sum(axis=1).mean())),
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences for the file and the terminal."""
        return tuple(self._sentences())

    def _sentences(self) -> Iterator[str]:
        if not self.parts:
            yield "It leaves out no part of the model that depends on the joint values alone."
        elif self.max_mm == 0.0:
            yield f"It leaves out {', '.join(self.parts)}, which have no influence at joint values alone."
        else:
            yield (
                f"It leaves out {', '.join(self.parts)}. Its positions therefore have an error of {self.rms_mm:.3g} mm "
                f"RMS over the work volume (95 % within {self.p95_mm:.3g} mm, {self.max_mm:.3g} mm at most), compared "
                f"with a correction of {self.correction_rms_mm:.3g} mm RMS."
            )
        yield from self.not_measured

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of `rigcal model export`."""
        return {
            "left_out": list(self.parts),
            "not_measured": list(self.not_measured),
            "rms_mm": self.rms_mm,
            "p95_mm": self.p95_mm,
            "max_mm": self.max_mm,
            "correction_rms_mm": self.correction_rms_mm,
        }


@dataclass(frozen=True)
class Export:
    """A model and the options of its export.

    Attributes:
        model: the model.
        manifest_sha256: SHA-256 of the model's manifest, which identifies the model.
        prisms: prisms of the grid; all prisms of the rig if empty.
        most_poses: greatest number of nodes of the grid.
    """

    model: CalibratedModel
    manifest_sha256: str
    prisms: tuple[str, ...] = ()
    most_poses: int = 20_000

    @cached_property
    def grid(self) -> CorrectionGrid:
        """The correction grid, computed once.

        Raises:
            DataError: as for `correction_grid`.
        """
        prisms = self.prisms or self.model.rig.prism_names
        return correction_grid(self.model, prisms, self.most_poses, np.random.default_rng(_SEED))

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """Size of the grid, its interpolation errors in mm, and `warnings` as sentences."""
        grid = self.grid
        return {
            "rows": len(grid.readings) * len(grid.nominal_mm),
            "poses": len(grid.readings),
            "nodes": {name: len(values) for name, values in grid.nodes.items()},
            "rms_mm": grid.rms_mm,
            "p95_mm": grid.p95_mm,
            "max_mm": grid.max_mm,
            "correction_rms_mm": grid.correction_rms_mm,
            "warnings": list(_warnings(grid)),
        }

    @cached_property
    def setup(self) -> int:
        """Index of the set-up whose base is known best; its direction of gravity is used."""
        return setup_of(self.model)

    def heading(self, left_out: LeftOut) -> tuple[str, ...]:
        """Return the lines at the head of a text export."""
        model = self.model
        return (
            f"Made by `rigcal model export` from the model of rig {model.rig.name} with manifest SHA-256 "
            f"{self.manifest_sha256 or 'unknown'}.",
            "Its base frame is that of the rig file; it does not contain the position of the base at a station set-up.",
            *left_out.sentences,
        )

    @cached_property
    def kinematics_alone(self) -> LeftOut:
        """What a format leaves out that contains only the identified kinematics."""
        return self.without(lambda _: False)

    def without(self, keeps: Callable[[FittedEffect], bool]) -> LeftOut:
        """Measure the error over the work volume of leaving out the residual and all effects that are not kept.

        Args:
            keeps: True for an effect that the export contains.
        """
        model = self.model
        whole = Machine(model, self.setup)
        lost = [effect for effect in whole.effects if not keeps(effect)]
        parts = [str(effect) for effect in lost]
        parts += [f"the learned residual ({model.residual.learner.kind})"] if model.residual is not None else []
        told = self.not_measured(lost)
        if not parts:
            return LeftOut((), told)
        rest = Machine(without_parts(model, [effect for effect in model.effects if effect not in lost]), self.setup)
        poses, extra = self.trial_poses()
        off, correction = [], []
        for prism in model.rig.prism_names:
            place_mm = whole.corrected_mm(prism, poses, extra)
            off.append(place_mm - rest.corrected_mm(prism, poses, extra))
            correction.append(place_mm - whole.nominal_mm(prism, poses))
        return LeftOut.of(parts, told, np.concatenate(off), np.concatenate(correction))

    @cached_property
    def left_out_of_grid(self) -> LeftOut:
        """What the grid leaves out: curvature between its nodes, and effects that need more than joint values."""
        grid, machine = self.grid, Machine(self.model, self.setup)
        poses, extra = self.trial_poses()
        off, correction = [], []
        for prism, nominal_mm in grid.nominal_mm.items():
            correction_mm = machine.corrected_mm(prism, poses, extra) - machine.nominal_mm(prism, poses)
            correction.append(correction_mm)
            off.append(interpolated(grid.nodes, grid.corrected_mm[prism] - nominal_mm, poses) - correction_mm)
        parts = [f"curvature between the nodes of {len(grid.readings)} poses", *map(str, grid.lacking)]
        return LeftOut.of(parts, self.not_measured(grid.lacking), np.concatenate(off), np.concatenate(correction))

    def trial_poses(self) -> tuple[Floats, dict[str, Floats]]:
        """Draw poses of the work volume: (n, joints) joint values, and further columns of their observations.

        The columns give each joint a random direction of its last motion.
        """
        low, high = trained_ranges(self.model)
        rng = np.random.default_rng(_SEED)
        poses = rng.uniform(low, high, (_POSES, len(low)))
        return poses, {f"{name}_dir": rng.choice([-1.0, 1.0], _POSES) for name in self.model.rig.joint_names}

    def not_measured(self, lost: Sequence[FittedEffect]) -> tuple[str, ...]:
        """Return sentences about the effects whose error the trial poses do not show.

        Args:
            lost: effects that move the machine and are left out.
        """
        of_machine = Machine(self.model, self.setup).effects
        told = [
            f"{effect} moves fixes or the base and is not part of any export."
            for effect in self.model.effects
            if effect not in of_machine
        ]
        lacking = [effect for effect in lost if (need := _needs(effect)) and not need.endswith("_dir")]
        told += [f"The error without {effect} is not measured here: it needs {_needs(effect)}." for effect in lacking]
        return tuple(told)


def without_parts(model: CalibratedModel, effects: Sequence[FittedEffect]) -> CalibratedModel:
    """Return a model with only the given effects and without a residual.

    Args:
        model: the model.
        effects: the effects to keep.
    """
    kept = [np.arange(len(model.values))]
    first = len(model.values)
    for effect in model.effects:
        last = first + len(effect.coefficients)
        if effect in effects:
            kept.append(np.arange(first, last))
        first = last
    own = np.concatenate(kept)
    effects = tuple(effect for effect in model.effects if effect in effects)
    return replace(model, effects=effects, residual=None, covariance=model.covariance[np.ix_(own, own)])


@dataclass(frozen=True)
class Format:
    """One export format.

    Attributes:
        name: value of `--format`.
        file: name of the file that it writes.
        about: description of the file, a phrase for the command's help.
        content: makes the content of the file.
        left_out: returns the parts of the model that the format leaves out, and the resulting error.
        is_default: True if it is written when no format is requested.
        has_grid: True if it contains the grid of corrections, whose summary and warnings the command prints.
        rig_text: makes the file from a chain, its parameters (p,) and remarks, if it describes kinematics alone.
            `rigcal rig export` uses it for the machine according to its drawings.
    """

    name: str
    file: str
    about: str
    content: Callable[[Export], bytes]
    left_out: Callable[[Export], LeftOut] = lambda _: LeftOut(())
    is_default: bool = False
    has_grid: bool = False
    rig_text: Callable[[Chain, Floats, Sequence[str]], str] | None = None


def kinematics_format(name: str, file: str, about: str, text: Callable[[Chain, Floats, Sequence[str]], str]) -> Format:
    """Return a text format that contains only the identified kinematics of the model.

    Args:
        name: as in `Format`.
        file: as in `Format`.
        about: as in `Format`.
        text: makes the text from a chain, its parameters (p,) and remarks.
    """

    def content(export: Export) -> bytes:
        model = export.model
        return text(model.chain, model.values, export.heading(export.kinematics_alone)).encode()

    return Format(name, file, about, content, lambda export: export.kinematics_alone, rig_text=text)


def shortest(value: float) -> str:
    """Return the shortest decimal number that reads back as `value`; zero has no sign."""
    return repr(float(value) + 0.0).removesuffix(".0")


def _needs(effect: FittedEffect) -> str:
    """Return the column that an effect needs; "" for none."""
    column = library()[effect.family].column
    return column.format(where=effect.where)


def _warnings(grid: CorrectionGrid) -> Iterator[str]:
    for effect in grid.lacking:
        yield f"{GRID_FILE} leaves out {effect}, which needs more than joint values; `rigcal predict` includes it"
    if grid.is_coarse:
        yield (
            f"between the nodes of {GRID_FILE}, interpolated corrections have an error of {grid.rms_mm:.2g} mm RMS, "
            f"more than a tenth of the corrections ({grid.correction_rms_mm:.2g} mm RMS); allow more rows (--rows), or "
            "use `rigcal predict` or the C header"
        )
