"""Evidence from the joints that a station is on the session's prism: the rigid fit of its targets.

Fixes between two instants at which a station may have changed its target are of one target: a stretch. Each stretch is
compared with the session's other stretches and with the poses of earlier sessions in the set-up, by
`calibration.identification.prism_identity`: while the base stands still, one rigid transform places all prisms. A
stretch that cannot be compared with anything yet is kept, and judged again whenever there are more fixes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix
from daemon.sessions.prisms.guard import Turn
from daemon.sessions.prisms.identity_loader import IdentityLoader
from daemon.sessions.prisms.sightings import Sighting, targets
from daemon.sessions.prisms.standstill_places import travel_mm
from daemon.sessions.station_setups import Place
from drivers.clock import Stamp

if TYPE_CHECKING:
    from calibration.identification.prism_identity import Misfits, PrismIdentity, Targets
    from daemon.sessions.prisms.motion import TargetMotion

LATE_S = 0.25  # largest difference between the instants of a fix and of its joints while the boom moves
MOST_SLACK_MM = 500.0  # a fix whose place is less certain than this, because of the motion, is not used
MOVED_MM = 100.0  # motion of the boom before another fix of a stretch is used
MOST_OF_STRETCH = 60  # largest number of fixes used of a stretch
MOST_OF_GROUP = 10  # largest number of fixes of a group in one comparison
MOST_STRETCHES = 40  # largest number of stretches kept for comparison
STRONG = 3  # number of targets at different poses that determine where the base stands
CLEARLY = 2.0  # factor by which a different prism must fit better, or worse


class Verdict(Enum):
    """Verdict of the joints on a stretch."""

    OPEN = "undecided"
    NAMED = "the session's prism"
    OTHER = "another target"


@dataclass(eq=False)
class Stretch:
    """Fixes of one target.

    Attributes:
        station: station that measured them.
        since: instant of the first fix.
        is_believed: an operator has confirmed that they are of the session's prism; the joints are not consulted.
        sightings: sightings that are used for comparison.
        instants_ns: monotonic instants of its observations whose exclusion depends on the target.
        verdict: verdict so far.
        is_sure: whether there were enough targets to compare with.
        is_doubted: its fixes are suspected at present, so they are no evidence for others.
    """

    station: str
    since: Stamp
    is_believed: bool = False
    sightings: list[Sighting] = field(default_factory=list)
    instants_ns: list[int] = field(default_factory=list)
    verdict: Verdict = Verdict.OPEN
    is_sure: bool = False
    is_doubted: bool = False


@dataclass(frozen=True)
class Finding:
    """A verdict that has changed.

    Attributes:
        stretch: the stretch.
        distance_m: distance of its target from where the joints place the session's prism.
        is_like: other prism, or `a stationary reflector`, that it fits instead; "" where it fits none.
    """

    stretch: Stretch
    distance_m: float = 0.0
    is_like: str = ""


class PrismEvidence:
    """The stretches of one session.

    Args:
        rig: the machine.
        prism: the session's prism.
        loader: loader of the mathematical code.
        earlier: groups of sightings that are relied on as long as they fit each other, oldest first: one of each
            earlier session in the set-up, and one of this session from before a restart of the daemon.
    """

    def __init__(
        self, rig: Rig, prism: str, loader: IdentityLoader, earlier: Sequence[Sequence[Sighting]] = ()
    ) -> None:
        self._rig, self._prism, self._loader = rig, prism, loader
        self._travel_mm = travel_mm(rig)
        self._earlier = [list(group) for group in earlier if group]
        self._stretches: list[Stretch] = []
        self._waits = False
        self._motion: TargetMotion | None = None

    def jump_m(self, joined: JoinedFix, place_mm: Place, turn: Turn, *, is_suspected: bool) -> float | None:
        """Add a fix, in order, moving or not, and return how far its target jumped, m; None if the joints explain it.

        Args:
            joined: the fix with its joints.
            place_mm: place of its target in the station's frame.
            turn: the station's last turn.
            is_suspected: the target may already be another prism.
        """
        self._motion = self._motion or self._loader.motion()
        if self._motion is None:
            return None
        return self._motion.jump_m(joined, place_mm, self._prism, turn.at, is_sure=not is_suspected)

    def stray_m(self, station: str) -> float | None:
        """Return how far the target of the newest fix has strayed since its turn, m; None if the joints explain it."""
        return None if self._motion is None else self._motion.stray_m(station, self._prism)

    def stretch(self, station: str, since: Stamp, is_believed: bool) -> Stretch:
        """Return the stretch of a station that began at `since`; create it if there is none."""
        for known in reversed(self._stretches):
            if known.station == station and known.since == since:
                return known
        made = Stretch(station, since, is_believed)
        self._stretches.append(made)
        if len(self._stretches) > MOST_STRETCHES:
            gone = next((s for s in self._stretches if s.verdict is Verdict.OTHER), self._stretches[0])
            self._stretches.remove(gone)
        return made

    def take(
        self, stretch: Stretch, joined: JoinedFix, place_mm: Place, is_doubted: Callable[[Stretch], bool]
    ) -> list[Finding]:
        """Add a fix to a stretch, and return the verdicts that change.

        Args:
            stretch: the stretch.
            joined: the fix with its joints.
            place_mm: place of its target in the station's frame.
            is_doubted: returns whether the fixes of a stretch are suspected at present.
        """
        sighting = self._sighting(joined, place_mm)
        is_new = sighting is not None and self._tells(stretch, sighting)
        if is_new and sighting is not None:
            if len(stretch.sightings) == MOST_OF_STRETCH:
                del stretch.sightings[::2]
            stretch.sightings.append(sighting)
        identity = self._loader.now()
        if identity is None:
            self._waits = True
            return []
        if not is_new and not self._waits:
            return []
        open_ones = self._stretches if self._waits else [stretch]
        self._waits = False
        for known in self._stretches:
            known.is_doubted = is_doubted(known)
        return self._judge(identity, open_ones)

    def _sighting(self, joined: JoinedFix, place_mm: Place) -> Sighting | None:
        joints = self._rig.joints
        if not all(joint.column in joined.values for joint in joints):
            return None
        rates = [(joint, abs(joined.values.get(f"{joint.name}_rate", 0.0))) for joint in joints]
        slack_mm = LATE_S * sum(rate * self._travel_mm[joint.column] for joint, rate in rates)
        if joined.standstill is not None:
            slack_mm = 0.0
        if slack_mm > MOST_SLACK_MM:
            return None
        return Sighting(self._prism, tuple(joined.values[joint.column] for joint in joints), place_mm, slack_mm)

    def _tells(self, stretch: Stretch, sighting: Sighting) -> bool:
        """Return True if the boom has moved since the stretch's last sighting."""
        if not stretch.sightings:
            return True
        changes = zip(self._rig.joints, sighting.joints, stretch.sightings[-1].joints, strict=True)
        return sum(abs(now - then) * self._travel_mm[joint.column] for joint, now, then in changes) > MOVED_MM

    def _judge(self, identity: PrismIdentity, stretches: Sequence[Stretch]) -> list[Finding]:
        """Judge stretches; if a verdict changes, judge all stretches again."""
        found: list[Finding] = []
        asked = list(stretches)
        for _ in range(3):
            news = [finding for stretch in asked for finding in self._judge_as_one(identity, [stretch])]
            news += self._judge_together(identity)
            found += news
            if not news:
                break
            asked = self._stretches
        return list({id(finding.stretch): finding for finding in found}.values())

    def _judge_together(self, identity: PrismIdentity) -> list[Finding]:
        """Judge together the stretches that are too short alone: all, those that fit each other, the suspected ones."""
        unsure = [s for s in self._stretches if not s.is_sure and not s.is_believed]
        if len(unsure) < 2:
            return []
        if news := self._judge_as_one(identity, unsure):
            return news
        most = self._most(identity, unsure)
        return self._judge_as_one(identity, most) or self._judge_as_one(identity, [s for s in most if s.is_doubted])

    def _most(self, identity: PrismIdentity, stretches: Sequence[Stretch]) -> Sequence[Stretch]:
        """Return the stretches that fit each other as the session's prism; none unless they are most of them."""
        kept = self._fitting(identity, [_some(stretch.sightings) for stretch in stretches])
        return [stretches[index] for index in kept] if 2 * len(kept) >= len(stretches) else []

    def _judge_as_one(
        self, identity: PrismIdentity, judged: Sequence[Stretch], beside: Sequence[Stretch] = ()
    ) -> list[Finding]:
        """Judge one stretch, or several that may be of one target, and return the verdicts that change.

        The verdict is sure if either the targets compared with or the stretches' own targets determine where the base
        stands. Several stretches, each too short by itself, are judged together only if the verdict is sure. A
        suspicion ends only if both together would determine it.

        Args:
            identity: the comparison of prisms.
            judged: the stretches.
            beside: stretches that are relied on although they are suspected.
        """
        sightings = [one for stretch in judged for one in _some(stretch.sightings)]
        if any(stretch.is_believed for stretch in judged) or not sightings:
            return []
        relied, own = self._relied_on(identity, judged, beside), targets(self._rig, sightings)
        if len(relied) + len(own) < 2:
            return []
        others, poses = self._poses(relied), self._poses(own)
        misfits, is_sure = identity.misfits(relied, own), others >= STRONG
        verdict = self._verdict(misfits, others, poses)
        if not is_sure and poses > STRONG:
            alone = identity.misfits(targets(self._rig, []), own)
            if (by_itself := self._verdict(alone, 0, poses)) is not Verdict.OPEN:
                misfits, verdict, is_sure = alone, by_itself, True
        is_sure = is_sure or (others > 0 and others + poses > STRONG and verdict is Verdict.NAMED)
        is_new_doubt = verdict is Verdict.OTHER or not judged[0].is_doubted
        if not is_sure and not (len(judged) == 1 and is_new_doubt):
            return []
        if len(judged) > 1 and verdict is Verdict.NAMED:  # most are of the prism; each must also fit by itself
            return [finding for stretch in judged for finding in self._judge_as_one(identity, [stretch], judged)]
        # Where nothing fits, the earlier verdict stays
        ends_doubt = len(judged) == 1 and judged[0].verdict is Verdict.OTHER and misfits.prism[self._index()] <= 1.0
        if verdict is Verdict.OPEN and not ends_doubt:
            return []
        changed = [stretch for stretch in judged if stretch.verdict is not verdict]
        for stretch in judged:
            stretch.verdict, stretch.is_sure = verdict, is_sure and verdict is not Verdict.OPEN
            stretch.is_doubted &= verdict is not Verdict.NAMED
        distance_m = float(misfits.distance_mm[self._index()]) / 1000
        return [Finding(stretch, distance_m, self._likeness(misfits, poses)) for stretch in changed]

    def _verdict(self, misfits: Misfits, relied: int, own: int) -> Verdict:
        """Return the verdict by targets at so many different poses, relied on and own."""
        named, other = float(misfits.prism[self._index()]), self._best_other(misfits, own)[0]
        if named <= 1.0:
            return Verdict.NAMED if other > max(1.0, CLEARLY * named) else Verdict.OPEN
        fits_another = other <= 1.0 and named > CLEARLY * other
        return Verdict.OTHER if fits_another or relied >= STRONG else Verdict.OPEN

    def _poses(self, seen: Targets) -> int:
        """Return at how many poses of the boom, `MOVED_MM` of motion apart, there are targets; at most STRONG + 1."""
        travel_mm = np.array([self._travel_mm[joint.column] for joint in self._rig.joints])
        different: list[npt.NDArray[np.float64]] = []
        for joints in seen.readings:
            if all(np.abs(joints - known) @ travel_mm > MOVED_MM for known in different):
                different.append(joints)
            if len(different) > STRONG:
                break
        return len(different)

    def _best_other(self, misfits: Misfits, own: int) -> tuple[float, str]:
        """Return the misfit and the name of the best-fitting other target, by own targets at so many poses."""
        named = [
            (float(misfit), f"prism {name}")
            for name, misfit in zip(self._rig.prism_names, misfits.prism, strict=True)
            if name != self._prism
        ]
        if own > 1:
            named.append((misfits.standing, "a stationary reflector"))
        return min(named, default=(np.inf, ""))

    def _likeness(self, misfits: Misfits, own: int) -> str:
        misfit, name = self._best_other(misfits, own)
        return name if misfit <= 1.0 else ""

    def _relied_on(self, identity: PrismIdentity, judged: Sequence[Stretch], beside: Sequence[Stretch] = ()) -> Targets:
        """Return the targets to compare with: groups that fit each other, without those that fit worst.

        Suspected stretches are left out, except those `beside`: each lock on one wrong target would fit the others.
        """
        groups = [_some(group) for group in self._earlier]
        is_later = False
        for stretch in self._stretches:
            if stretch in judged:
                is_later = True
            # An operator's confirmation applies from its instant on, never to earlier fixes
            elif (
                stretch.verdict is not Verdict.OTHER
                and not (stretch.is_doubted and stretch not in beside)
                and not (is_later and stretch.is_believed)
            ):
                groups.append(_some(stretch.sightings))
        kept = self._fitting(identity, groups)
        return targets(self._rig, [one for index in kept for one in groups[index]])

    def _fitting(self, identity: PrismIdentity, groups: Sequence[Sequence[Sighting]]) -> list[int]:
        """Return the indices of the groups that fit each other, without those that fit worst; empty groups are none."""
        kept = [index for index, group in enumerate(groups) if group]
        while kept:
            joined = targets(self._rig, [one for index in kept for one in groups[index]])
            ends = np.cumsum([len(groups[index]) for index in kept])[:-1]
            misfits = [float(np.median(of_group)) for of_group in np.split(identity.own_misfits(joined), ends)]
            if max(misfits) <= 1.0:
                break
            kept.pop(len(kept) - 1 - misfits[::-1].index(max(misfits)))  # of two that fit alike, the later one
        return kept

    def _index(self) -> int:
        return self._rig.prism_names.index(self._prism)


def _some(sightings: Sequence[Sighting]) -> Sequence[Sighting]:
    """Return a few of a stretch's sightings, spread over its whole length."""
    return sightings[:: math.ceil(len(sightings) / MOST_OF_GROUP) or 1]
