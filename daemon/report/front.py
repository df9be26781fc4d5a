"""The front of every report: its subject, the verdict, the accuracy, and the signatures."""

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
    """The subject of a report; missing items are shown as `not given`.

    Attributes:
        rig: name of the rig.
        model: number, directory or hash of the model.
        sessions: sessions of the measurement.
        operators: people who were responsible.
        instruments: total stations.
        setups: station set-ups.
        measured_utc_ns: first and last instant of the measurement.
        made_utc_ns: time of the report; without it the same input gives the same bytes.
        tolerance_mm: permitted root mean square error; None if none is stated.
        is_simulated: True if a simulated rig was measured.
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
    is_simulated: bool = False

    def lines(self) -> dict[str, str]:
        """Return label -> text, in reading order."""
        return {
            "Rig": self.rig,
            **({"Simulated": "measured on a simulated rig, in simulated time"} if self.is_simulated else {}),
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
    """Verdict on an error compared with the tolerance.

    Attributes:
        tolerance_mm: stated tolerance.
        rms_mm: root mean square error that is compared with the tolerance.
        outcome: passed, failed, or not judged; fixes that the model was fitted to cannot pass.
        rows: words for the fixes, e.g. `on 94 held-out fixes`.
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
    """Compare an error with a tolerance; return None if no tolerance is stated.

    Args:
        tolerance_mm: permitted root mean square error.
        rms_mm: the error.
        is_held_out: True if the model was not fitted to these fixes.
        rows: words for the fixes, e.g. `on 94 held-out fixes`.
    """
    if tolerance_mm is None:
        return None
    is_within = math.isfinite(rms_mm) and rms_mm <= tolerance_mm
    outcome: Outcome = "failed" if not is_within else "passed" if is_held_out else "not judged"
    return Verdict(tolerance_mm, rms_mm, outcome, rows)


@dataclass(frozen=True)
class Accuracy:
    """Accuracy in one sentence, with a table of figures if there is more than one.

    Attributes:
        sentence: the result.
        columns: heading -> figure in mm; empty if the sentence contains the only figure.
    """

    sentence: str
    columns: Mapping[str, float] = field(default_factory=dict)


def front(facts: Facts, verdict: Verdict | None, accuracy: Accuracy) -> str:
    """Return the first lines of a report as HTML: facts, verdict, accuracy."""
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
    """Return the block for the handwritten signatures of those responsible for the report."""
    return markup.signature_block(_SIGNATURES)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(name for name in names if name)) or NOT_GIVEN


def _instant(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M} UTC"
