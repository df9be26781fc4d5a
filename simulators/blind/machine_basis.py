"""Directions in which the effects of a machine may show, to tell whether each shows beside all the others."""

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
_KNOTS = 16  # of a free curve of a joint's angle, over its range
_STEP_RAD, _STEP_MM = 1e-5, 1e-2
_FLAT = 1e-6  # of the largest: directions with less have no share in a covariance


class MachineBasis:
    """Visible columns of effects in a scene, in units of the noise.

    Args:
        scene: the data.
        visibility: of displacements in it.
    """

    def __init__(self, scene: Scene, visibility: Visibility) -> None:
        self._scene = scene
        self._visibility = visibility
        self._signals: dict[Effect, Floats] = {}
        self._spaces: dict[Effect, Floats] = {}

    def beside(self, effects: Sequence[Effect]) -> tuple[float, ...]:
        """Return the visible size of each effect that the others, with any coefficients, do not imitate."""
        spaces = [self._space(effect) for effect in effects]
        out = []
        for number, effect in enumerate(effects):
            others = [space for other, space in enumerate(spaces) if other != number]
            signal = self._shown(effect)
            left = signal - _within(np.hstack(others), signal) if others else signal
            out.append(float(np.sqrt(np.mean(left**2))))
        return tuple(out)

    def described(self, displacement_mm: Floats) -> float:
        """Return the largest share of the square of a displacement (n, 3) that one effect of the library takes."""
        signal = self._visibility.seen(displacement_mm[:, :, None])[:, 0]
        return max(float(np.sum((Q.T @ signal) ** 2) / np.sum(signal**2)) for Q in self._orthonormal)

    def separable(self, effects: Sequence[Effect], unknown: float) -> tuple[bool, ...]:
        """Return, for each effect, whether the data tell it from every other effect and place.

        The other hidden effects may have any coefficients meanwhile, and structure of pairs of joints is unknown.

        Args:
            effects: hidden ones.
            unknown: visible size of that structure.
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
        """(3 n,) visible displacement by an effect."""
        if effect not in self._signals:
            moved_mm = self._scene.displacement_mm([effect])
            self._signals[effect] = self._visibility.seen(moved_mm[:, :, None])[:, 0]
        return self._signals[effect]

    def _space(self, effect: Effect) -> Floats:
        """(3 n, k) columns of all that an effect's coefficients may do."""
        if effect not in self._spaces:
            if effect.family in _CURVES:
                self._spaces[effect] = self._curves(effect.where)
            else:
                self._spaces[effect] = effect_columns(self._scene, self._visibility, effect)
        return self._spaces[effect]

    def _curves(self, joint: str) -> Floats:
        """(3 n, k) columns of a free curve of a joint's angle, each of 1 mrad."""
        read = self._read
        at = scaled_reading(self._scene.truth.rig, joint, read)
        knots = np.linspace(-1.0, 1.0, _KNOTS)
        hats = np.maximum(1.0 - np.abs(at[:, None] - knots) / (knots[1] - knots[0]), 0.0)
        return self._visibility.seen(1e-3 * self._by_joint[joint][:, :, None] * hats[:, None, :])

    @cached_property
    def _library(self) -> list[tuple[Effect, Floats]]:
        """Every form of every effect of the library at all its places, with its columns; free curves apart."""
        return [(form, self._visibility.seen(mm)) for form, mm in library_columns_mm(self._scene)]

    @cached_property
    def _orthonormal(self) -> list[Floats]:
        """Orthonormal columns of every effect of the library, free curves of each revolute joint among them."""
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
        """(3 n, 3 n) of noise and of unknown structure of this visible size, spread over all pairs and all joints."""
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
    """(n, n) covariance of a curve about its mean over -1 to 1."""
    even = np.linspace(-1.0, 1.0, 41)

    def kernel(a: Floats, b: Floats) -> Floats:
        return np.exp(-0.5 * ((a[:, None] - b) / LENGTH) ** 2)

    mean = kernel(at, even).mean(axis=1)
    centred: Floats = kernel(at, at) - mean[:, None] - mean + kernel(even, even).mean()
    return centred


def _free_of(Q: Floats, columns: Floats) -> Floats:
    """Return columns, or one, without what lies in the space of orthonormal columns Q."""
    left: Floats = columns - Q @ (Q.T @ columns)
    return left


def _within(columns: Floats, signal: Floats) -> Floats:
    """(m,) part of a signal that columns (m, k) imitate."""
    U, S, _ = np.linalg.svd(columns, full_matrices=False)
    kept = U[:, _FLAT * S[0] < S]
    inside: Floats = kept @ (kept.T @ signal)
    return inside
