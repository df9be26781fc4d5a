"""The store's table of check sessions held against the live model, and the two sums that say whether it has drifted.

The sums (`calibration.cusum`) begin anew whenever a model goes live, one that is put back included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calibration.cusum import DECISION, Cusum
from daemon.store.store import Store
from drivers.clock import Clock

# As the jobs' queries this runs twice a second for months: each step finds its rows by an index.
_LIVE = """SELECT state.id AS since, model.id AS model_id, coalesce(state.after_session, 0) AS after_session
    FROM models AS model CROSS JOIN model_states AS state ON state.model_id = model.id
    WHERE model.rig = ? AND model.state = 'live' AND state.state = 'live' AND state.zeros_checked_through IS NULL
    ORDER BY state.id DESC LIMIT 1"""
_ALARM = """SELECT session.rowid AS number, session.id FROM drift_checks AS drift
    CROSS JOIN calibration_sessions AS session ON session.id = drift.session_id
    WHERE drift.live_since = ? AND drift.alarm = 'worse' ORDER BY drift.id LIMIT 1"""


@dataclass(frozen=True)
class LiveRun:
    """From a model's going live until another does.

    Attributes:
        since: number of the change by which it went live.
        model_id: which model.
        after_session: number of the rig's newest session then.
    """

    since: int
    model_id: int
    after_session: int


class DriftTable:
    """Drift of one rig's live model.

    Args:
        store: where it is.
        rig_name: whose model.
        clock: for when what was noted.
    """

    def __init__(self, store: Store, rig_name: str, clock: Clock) -> None:
        self._store, self._rig, self._clock = store, rig_name, clock

    def run(self) -> LiveRun | None:
        """The live model's run; None where none is live."""
        found = self._store.rows(_LIVE, (self._rig,))
        return LiveRun(**found[0]) if found else None

    def drifted(self, run: LiveRun) -> tuple[int, str] | None:
        """Number and id of the check session that raised the alarm; None before."""
        found = self._store.rows(_ALARM, (run.since,))
        return (found[0]["number"], found[0]["id"]) if found else None

    def unseen(self, run: LiveRun, checks: Sequence[tuple[int, str]], trained: Sequence[str]) -> tuple[str, ...]:
        """Of check sessions (number, id) those that count for a run and were not held against its model yet.

        Args:
            run: the live model's.
            checks: closed check sessions, oldest first.
            trained: sessions that the model was trained on.
        """
        rows = self._store.rows("SELECT session_id FROM drift_checks WHERE live_since = ?", (run.since,))
        known = {row["session_id"] for row in rows} | set(trained)
        return tuple(name for number, name in checks if number > run.after_session and name not in known)

    def note(self, drift: Mapping[str, Any]) -> None:
        """Add what a drift job found, in the transaction of the caller; a session that is there already is kept."""
        since = drift["live_since"]
        for check in drift["checks"]:
            rows = self._store.rows("SELECT session_id, upper, lower FROM drift_checks WHERE live_since = ?", (since,))
            if any(row["session_id"] == check["session"] for row in rows):
                continue
            before = Cusum(rows[-1]["upper"], rows[-1]["lower"]) if rows else Cusum()
            after = before.after(check["scores"])
            row = {
                "live_since": since,
                "session_id": check["session"],
                "fixes": check["fixes"],
                "standstills": len(check["scores"]),
                "ratio": check["ratio"],
                "reason": check["reason"],
                "upper": after.upper,
                "lower": after.lower,
                "alarm": after.alarm,
            }
            self._store.insert("drift_checks", row | self._store.instant(self._clock.now()))

    def status(self) -> dict[str, Any] | None:
        """What `status` shows; None where no model is live."""
        run = self.run()
        if run is None:
            return None
        rows = self._store.rows(
            "SELECT session_id, standstills, ratio, reason, upper, lower, alarm FROM drift_checks "
            "WHERE live_since = ? ORDER BY id",
            (run.since,),
        )
        newest = rows[-1] if rows else {"session_id": None, "ratio": None, "reason": ""}
        drifted = self.drifted(run)
        return {
            "model": run.model_id,
            "checks": len(rows),
            "standstills": sum(row["standstills"] for row in rows),
            "newest": newest["session_id"],
            "ratio": newest["ratio"],
            "reason": newest["reason"],
            "upper": rows[-1]["upper"] if rows else 0.0,
            "lower": rows[-1]["lower"] if rows else 0.0,
            "decision": DECISION,
            "alarm": "worse" if drifted else rows[-1]["alarm"] if rows else "none",
            "drifted_with": drifted[1] if drifted else None,
        }
