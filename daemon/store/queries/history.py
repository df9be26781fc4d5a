"""Histories shown on the page: a session's fixes, drift of the live models, control points, changes of models."""

from __future__ import annotations

from typing import Any

from daemon.store.rows import RowSource

_MOST = 2000  # newest rows in a list

_FIXES = """SELECT id, pose, utc_ns, x_mm, y_mm, z_mm, dwell_s, excluded FROM observations
    WHERE session_id = ? ORDER BY id DESC LIMIT ?"""
_DRIFT = """SELECT drift.session_id AS session, drift.utc_ns, state.model_id AS model, drift.fixes, drift.standstills,
        drift.ratio, drift.reason, drift.upper, drift.lower, drift.alarm
    FROM drift_checks AS drift JOIN model_states AS state ON state.id = drift.live_since
        JOIN models AS model ON model.id = state.model_id
    WHERE model.rig = ? ORDER BY drift.id DESC LIMIT ?"""
_SHOTS = """SELECT setup_id AS setup, name AS point, session_id AS session, phase, utc_ns, misclosure_mm
    FROM control_shots WHERE misclosure_mm IS NOT NULL ORDER BY id DESC LIMIT ?"""
_CHANGES = """SELECT state.model_id AS model, state.state, state.utc_ns, state.operator, state.caller_user AS user,
        state.reason FROM model_states AS state JOIN models AS model ON model.id = state.model_id
    WHERE model.rig = ? ORDER BY state.id DESC LIMIT ?"""


def session_fixes(source: RowSource, session_id: str) -> list[dict[str, Any]] | None:
    """Return a session's newest fixes with the reasons of exclusions, oldest first; None for an unknown session."""
    if not list(source.rows("SELECT 1 FROM calibration_sessions WHERE id = ?", (session_id,))):
        return None
    return list(source.rows(_FIXES, (session_id, _MOST)))[::-1]


def drift_history(source: RowSource, rig_name: str) -> list[dict[str, Any]]:
    """Return all comparisons of check sessions with the model that was live at the time, oldest first."""
    return list(source.rows(_DRIFT, (rig_name, _MOST)))[::-1]


def misclosure_history(source: RowSource) -> list[dict[str, Any]]:
    """Return the control points' misclosures, oldest first."""
    return list(source.rows(_SHOTS, (_MOST,)))[::-1]


def model_changes(source: RowSource, rig_name: str) -> list[dict[str, Any]]:
    """Return every change of a model's state, oldest first."""
    return list(source.rows(_CHANGES, (rig_name, _MOST)))[::-1]
