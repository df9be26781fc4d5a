"""A session's fixes with the residuals of the live model."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from daemon.store.files import FileIdentity
from daemon.store.queries.history import session_fixes
from daemon.store.reader import Reader

_Key = tuple[str, int, str]


class SessionFixes:
    """Reads a session's fixes with their residuals, one request at a time; the result is cached until data change.

    Heavy modules are imported only when residuals are first requested.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._model: tuple[str, Any] | None = None
        self._kept: tuple[_Key, dict[str, Any]] | None = None

    def read(
        self, store: Path, identity: FileIdentity | None, session_id: str, model: dict[str, Any] | None
    ) -> dict[str, Any] | None:
        """Return the fixes of a session, oldest first; None if there is no such session.

        Args:
            store: the database.
            identity: identity that the file must have; None for any.
            session_id: ID of the session.
            model: the live model, as `model.show` returns it; None if no model is live.

        Returns:
            `fixes`: id, pose, utc_ns, x_mm, y_mm, z_mm, dwell_s, excluded of each, and residual_mm: [x, y, z] measured
            minus predicted, None without a prediction; `model`: number of the model; `note`: why there are no
            residuals, or what they are based on, a sentence; "" for no note.

        Raises:
            StoreError: the store cannot be read, or the file is a different one.
        """
        sha256 = "" if model is None else str(model["manifest_sha256"])
        with self._turn, Reader(store, identity) as reader, reader.snapshot():
            fixes = session_fixes(reader, session_id)
            if fixes is None:
                return None
            key = session_id, hash(tuple((fix["id"], fix["excluded"]) for fix in fixes)), sha256
            if self._kept is None or self._kept[0] != key:
                self._kept = key, self._beside(reader, session_id, fixes, model)
            return self._kept[1]

    def _beside(
        self, reader: Reader, session_id: str, fixes: list[dict[str, Any]], model: dict[str, Any] | None
    ) -> dict[str, Any]:
        residuals: dict[int, list[float]] = {}
        note = "No model is live: residuals appear once a model is live."
        if model is not None:
            used = [fix["id"] for fix in fixes if fix["excluded"] is None]
            residuals, note = self._residuals(reader, session_id, used, model) if used else ({}, "")
        shown = [fix | {"residual_mm": residuals.get(fix["id"])} for fix in fixes]
        return {"fixes": shown, "model": None if model is None else model["id"], "note": note}

    def _residuals(
        self, reader: Reader, session_id: str, used: list[int], model: dict[str, Any]
    ) -> tuple[dict[int, list[float]], str]:
        """Return number of a used fix -> residual in mm, and a note on the residuals."""
        import numpy as np

        from calibration.errors import CalibrationError
        from calibration.model.prediction import Predictor
        from calibration.model.rebase import with_refitted_base
        from calibration.observations import parse_observations
        from daemon.sessions.session_data import sessions_csv

        try:
            live = self._loaded(model)
            rows = parse_observations(sessions_csv(reader, live.rig, [session_id]), live.rig, f"session {session_id}")
            note = ""
            if not set(rows.setup.tolist()) <= set(live.placements):
                live = with_refitted_base(live, rows)
                note = "The live model does not know this set-up: its base is fitted to these same fixes."
            errors_mm = rows.position_mm - Predictor.of(live).predict(rows).position_mm
        except (CalibrationError, OSError) as error:
            return {}, f"No residuals: {error}"
        # The newest of the session's used fixes, in the same order.
        return dict(zip(used, np.round(errors_mm[-len(used) :], 3).tolist(), strict=True)), note

    def _loaded(self, model: dict[str, Any]) -> Any:
        from daemon.models.model_files import read_model

        sha256 = str(model["manifest_sha256"])
        if self._model is None or self._model[0] != sha256:
            self._model = sha256, read_model(Path(str(model["path"])), sha256)
        return self._model[1]
