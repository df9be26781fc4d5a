"""The front of every report: what it is of, whether it passed, how accurate, and who signs for it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Literal

from daemon.report import markup
from daemon.report.words import number
from daemon.version import VERSION
from drivers.clock import NS_PER_S

NOT_GIVEN = "not given"
NO_TOLERANCE = "no tolerance stated"
_SIGNATURES = ("Measured by", "Checked by", "Accepted by")

Outcome = Literal["passed", "failed", "not judged"]


@dataclass(frozen=True)
class Facts:
    """The subject of a report; what nobody has said is `not given`.

    Attributes:
        rig: its name.
        model: number, directory or hash of the model.
        sessions: measured in.
        operators: who were responsible.
        instruments: total stations.
        setups: station set-ups.
        measured_utc_ns: first and last instant of the measurement.
        made_utc_ns: when the report was made; without it the same input gives the same bytes.
        tolerance_mm: root mean square error that the machine may have; None where none is stated.
    """

    rig: str
    model: str = ""
    sessions: Sequence[str] = ()
    operators: Sequence[str] = ()
    instruments: Sequence[str] = ()
    setups: Sequence[str] = ()
    measured_utc_ns: tuple[int, int] | None = None
    made_utc_ns: int | None = None
    tolerance_mm: float | None = None

    def lines(self) -> dict[str, str]:
        """Return label -> text, in the order in which they are read."""
        return {
            "Rig": self.rig,
            "Model": self.model or NOT_GIVEN,
            "Sessions": _listed(self.sessions),
            "Operator": _listed(self.operators),
            "Instrument": _listed(self.instruments),
            "Station set-up": _listed(self.setups),
            "UTC": self._utc(),
            "Software": f"rigcal {VERSION}",
        }

    def _utc(self) -> str:
        told = []
        if self.measured_utc_ns is not None:
            first, last = map(_instant, self.measured_utc_ns)
            told.append(f"measured {first}" + (f" to {last}" if last != first else ""))
        if self.made_utc_ns is not None:
            told.append(f"report made {_instant(self.made_utc_ns)}")
        return "; ".join(told) or NOT_GIVEN


@dataclass(frozen=True)
class Verdict:
    """Judgement of an error against the tolerance.

    Attributes:
        tolerance_mm: that was stated.
        rms_mm: the error that is held against it.
        outcome: passed, failed, or not judged: on fixes that the model was fitted to nothing can pass.
        rows: which fixes.
    """

    tolerance_mm: float
    rms_mm: float
    outcome: Outcome
    rows: str

    @property
    def sentence(self) -> str:
        """The verdict with its figures."""
        held = f"{number(self.rms_mm)} mm root mean square {self.rows}, tolerance {number(self.tolerance_mm)} mm"
        if self.outcome == "not judged":
            other = "hold a check session, or evaluate the model on other data"
            return f"Not judged: {held}. Only fixes that the model has not seen can pass: {other}."
        return f"{self.outcome.capitalize()}: {held}."

    def as_dict(self) -> dict[str, float | str]:
        """Return the JSON object."""
        return {"tolerance_mm": self.tolerance_mm, "rms_mm": self.rms_mm, "verdict": self.outcome}


def judge(tolerance_mm: float | None, rms_mm: float, *, is_held_out: bool, rows: str) -> Verdict | None:
    """Hold an error against a tolerance; None where none is stated.

    Args:
        tolerance_mm: root mean square error that the machine may have.
        rms_mm: the error.
        is_held_out: the model was not fitted to these fixes.
        rows: which fixes, as `on 94 held-out fixes`.
    """
    if tolerance_mm is None:
        return None
    is_within = math.isfinite(rms_mm) and rms_mm <= tolerance_mm
    outcome: Outcome = "failed" if not is_within else "passed" if is_held_out else "not judged"
    return Verdict(tolerance_mm, rms_mm, outcome, rows)


@dataclass(frozen=True)
class Accuracy:
    """Accuracy in one sentence, with figures side by side where they differ.

    Attributes:
        sentence: of the result.
        columns: heading -> figure in mm; none where one figure says it all.
    """

    sentence: str
    columns: Mapping[str, float] = field(default_factory=dict)


def front(facts: Facts, verdict: Verdict | None, accuracy: Accuracy) -> str:
    """Return the first lines of a report as HTML: facts, pass or fail, accuracy."""
    box = markup.paragraph(f"Tolerance: {NO_TOLERANCE}.", "verdict")
    if verdict is not None:
        box = markup.paragraph(verdict.sentence, f"verdict {verdict.outcome.replace(' ', '-')}")
    columns = ""
    if accuracy.columns:
        figures = [[f"{number(value)} mm" for value in accuracy.columns.values()]]
        columns = markup.table(list(accuracy.columns), figures, text_columns=range(len(accuracy.columns)))
    said = markup.unbroken(box + markup.paragraph(accuracy.sentence, "accuracy"))
    return markup.facts(facts.lines()) + said + columns


def signatures() -> str:
    """Return the block in which those sign by hand who answer for the report."""
    return markup.signature_block(_SIGNATURES)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(name for name in names if name)) or NOT_GIVEN


def _instant(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M} UTC"
