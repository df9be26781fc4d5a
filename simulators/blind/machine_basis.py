"""Visible directions of a machine's effects, to check whether each effect is visible in addition to all others."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from simulators.blind.alternatives import MARGIN, SIGMAS, effect_columns, library_columns_mm, weigh
from simulators.blind.scene import Scene
from simulators.blind.visibility import Visibility
from simulators.effects.base import Effect
from simulators.effects.unknown import LENGTH, scaled_reading
from simulators.rig.screws import Floats

_CURVES = ("joint_error_map",)
_KNOTS = 16  # number of knots of a free curve over a joint's range
_STEP_RAD, _STEP_MM = 1e-5, 1e-2
_FLAT = 1e-6  # directions below this share of the largest value are dropped


class MachineBasis:
    """Visible columns of effects in a scene, in units of the noise.

    Args:
        scene: the data.
        visibility: visible part of displacements in the scene.
    """

    def __init__(self, scene: Scene, visibility: Visibility) -> None:
        self._scene = scene
        self._visibility = visibility
        self._signals: dict[Effect, Floats] = {}
        self._spaces: dict[Effect, Floats] = {}

    def beside(self, effects: Sequence[Effect]) -> tuple[float, ...]:
        """Return the visible size of each effect's part that the others, with any coefficients, cannot imitate."""
        spaces = [self._space(effect) for effect in effects]
        out = []
        for number, effect in enumerate(effects):
            others = [space for other, space in enumerate(spaces) if other != number]
            signal = self._shown(effect)
            left = signal - _within(np.hstack(others), signal) if others else signal
            out.append(float(np.sqrt(np.mean(left**2))))
        return tuple(out)

    def described(self, displacement_mm: Floats) -> float:
        """Return the largest share of a squared visible displacement that a single effect of the library explains.

        Args:
            displacement_mm: (n, 3) displacement.
        """
        signal = self._visibility.seen(displacement_mm[:, :, None])[:, 0]
        return max(float(np.sum((Q.T @ signal) ** 2) / np.sum(signal**2)) for Q in self._orthonormal)

    def separable(self, effects: Sequence[Effect], unknown: float) -> tuple[bool, ...]:
        """Return, for each effect, True if the data distinguish it from every other effect and place.

        The other hidden effects may have any coefficients, and structure that depends on pairs of joints is unknown.

        Args:
            effects: the hidden effects.
            unknown: visible size of the unknown structure.
        """
        whiten = np.linalg.inv(np.linalg.cholesky(self._covariance(unknown)))
        spaces = [whiten @ self._space(effect) for effect in effects]
        signals = [whiten @ self._shown(effect) for effect in effects]
        alternatives = [(form, whiten @ columns) for form, columns in self._library]
        hidden = {(effect.family, effect.where) for effect in effects}
        told = []
        for number, signal in enumerate(signals):
            Q, _ = np.linalg.qr(np.hstack([space for other, space in enumerate(spaces) if other != number]))
            own, fit = weigh(_free_of(Q, spaces[number]), _free_of(Q, signal))
            worst = np.inf
            for form, columns in alternatives:
                if (form.family, form.where) in hidden:
                    continue
                evidence, imitation = weigh(_free_of(Q, columns), _free_of(Q, signal))
                worst = min(worst, own - evidence - SIGMAS * float(np.linalg.norm(fit - imitation)))
            told.append(bool(worst >= MARGIN))
        return tuple(told)

    def _shown(self, effect: Effect) -> Floats:
        """Return the (3 n,) visible displacement by an effect."""
        if effect not in self._signals:
            moved_mm = self._scene.displacement_mm([effect])
            self._signals[effect] = self._visibility.seen(moved_mm[:, :, None])[:, 0]
        return self._signals[effect]

    def _space(self, effect: Effect) -> Floats:
        """Return (3 n, k) columns that span the visible displacements by any coefficients of an effect."""
        if effect not in self._spaces:
            if effect.family in _CURVES:
                self._spaces[effect] = self._curves(effect.where)
            else:
                self._spaces[effect] = effect_columns(self._scene, self._visibility, effect)
        return self._spaces[effect]

    def _curves(self, joint: str) -> Floats:
        """Return the (3 n, k) columns of a free curve of a joint's angle, each for 1 mrad."""
        read = self._read
        at = scaled_reading(self._scene.truth.rig, joint, read)
        knots = np.linspace(-1.0, 1.0, _KNOTS)
        hats = np.maximum(1.0 - np.abs(at[:, None] - knots) / (knots[1] - knots[0]), 0.0)
        return self._visibility.seen(1e-3 * self._by_joint[joint][:, :, None] * hats[:, None, :])

    @cached_property
    def _library(self) -> list[tuple[Effect, Floats]]:
        """Every variant of every library effect at all its places, with its columns; without free curves."""
        return [(form, self._visibility.seen(mm)) for form, mm in library_columns_mm(self._scene)]

    @cached_property
    def _orthonormal(self) -> list[Floats]:
        """Orthonormal columns of every effect of the library, including free curves of each revolute joint."""
        curves = [self._curves(joint) for joint in self._scene.draws.places(_CURVES[0])]
        return [np.linalg.qr(columns)[0] for columns in (*(columns for _, columns in self._library), *curves)]

    @property
    def _read(self) -> dict[str, Floats]:
        rig, joints = self._scene.truth.rig, self._scene.training.joints
        return {j.name: np.deg2rad(joints[j.name]) if j.kind == "revolute" else joints[j.name] for j in rig.joints}

    @cached_property
    def _by_joint(self) -> dict[str, Floats]:
        """Joint name -> (n, 3) displacement per rad or mm of its true value."""
        fixes, truth = self._scene.training, self._scene.truth
        out = {}
        for joint in truth.rig.joints:
            step = np.rad2deg(_STEP_RAD) if joint.kind == "revolute" else _STEP_MM
            moved = {**fixes.joints, joint.name: fixes.joints[joint.name] + step}
            unit = _STEP_RAD if joint.kind == "revolute" else _STEP_MM
            out[joint.name] = (fixes.places_mm(truth, moved) - fixes.places_mm(truth)) / unit
        return out

    def _covariance(self, size: float) -> Floats:
        """Return the (3 n, 3 n) covariance of noise and of unknown structure of this visible size.

        The structure is spread evenly over all pairs and all joints.
        """
        rig, n = self._scene.truth.rig, len(self._scene.training.prism)
        read = self._read
        single = [_centred_kernel(scaled_reading(rig, name, read)) for name in rig.joint_names]
        pairs = np.zeros((n, n))
        for first in range(len(single)):
            for second in range(first):
                pairs += single[first] * single[second]
        total = np.zeros((n, 3, n, 3))
        for moved in self._by_joint.values():
            column = moved / np.sqrt(np.mean(moved**2))
            total += column[:, :, None, None] * column * pairs[:, None, :, None]
        total += len(rig.joints) * np.eye(3)[:, None, :] * pairs[:, None, :, None]
        flat = total.reshape(3 * n, 3 * n)
        values, vectors = np.linalg.eigh(flat)
        kept = values > _FLAT * values[-1]
        factor = (vectors[:, kept] * np.sqrt(values[kept])).reshape(n, 3, -1)
        shown = self._visibility.seen(factor)
        covariance = shown @ shown.T
        scaled: Floats = np.eye(3 * n) + covariance * (size**2 / np.mean(np.diag(covariance)))
        return scaled


def _centred_kernel(at: Floats) -> Floats:
    """Return the (n, n) covariance of a curve about its mean over -1 to 1."""
    even = np.linspace(-1.0, 1.0, 41)

    def kernel(a: Floats, b: Floats) -> Floats:
        return np.exp(-0.5 * ((a[:, None] - b) / LENGTH) ** 2)

    mean = kernel(at, even).mean(axis=1)
    centred: Floats = kernel(at, at) - mean[:, None] - mean + kernel(even, even).mean()
    return centred


def _free_of(Q: Floats, columns: Floats) -> Floats:
    """Return one or several columns without their part in the space of the orthonormal columns Q."""
    left: Floats = columns - Q @ (Q.T @ columns)
    return left


def _within(columns: Floats, signal: Floats) -> Floats:
    """Return the (m,) part of a signal that the (m, k) columns can imitate."""
    U, S, _ = np.linalg.svd(columns, full_matrices=False)
    kept = U[:, _FLAT * S[0] < S]
    inside: Floats = kept @ (kept.T @ signal)
    return inside
