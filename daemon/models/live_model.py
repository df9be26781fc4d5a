"""The live model in memory: loaded in the background, and again whenever a different model goes live.

Loading is retried periodically if it failed: a missing resource may be available again, or the files may be restored.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from calibration.errors import CalibrationError, ModelError, UnsafeError
from calibration.rig.description import Rig
from daemon.host.worker_thread import WorkerThread
from daemon.store.queries.models import ModelRow, ModelTable
from daemon.store.queries.time_axis import TimeAxis

if TYPE_CHECKING:
    from calibration.model.model import CalibratedModel

log = logging.getLogger(__name__)

NO_MODEL = "no model is live; `rigcal model list` shows the candidates"
LOADING = "the live model is being loaded"
UNKNOWN_JUMPS = (
    "the live model cannot be used: the store is damaged, so it does not show which encoders have jumped or which "
    "devices are faulty; restore a backup (`rigcal store restore`)"
)
JUMPED = "the reading of a joint has jumped; the live model is not used before that is stored"
RETRY_S = 30.0  # after a failed load
STOP_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class Loaded:
    """The live model.

    Attributes:
        id: its number in the store.
        model: to predict with.
        jumped: joints whose readings jumped since the model was trained, so that their zeros may differ from it.
        time_axis: the axis of `time_s` in its training data, as of the time of loading.
        sessions: on which it was trained.
    """

    id: int
    model: CalibratedModel
    jumped: tuple[str, ...]
    time_axis: TimeAxis
    sessions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Missing:
    """The reason why there is no live model to predict with.

    Attributes:
        reason: a sentence.
        is_defect: whether a model is live but cannot be used.
        is_hindered: whether the computer and not the model is the cause.
    """

    reason: str
    is_defect: bool = False
    is_hindered: bool = False


@dataclass(frozen=True)
class LiveModelHealth:
    """Faults of the live model.

    Attributes:
        id: its number in the store.
        jumped: joints whose encoder has jumped since the model was trained and whose zeros were not checked since.
        defect: why the model cannot be used; "" if it can, or if that is unknown.
        hindrance: what prevents the computer from loading it; "" if nothing does.
        drifted_with: the check session that showed drift; None if there is no drift.
        rejected: a session on which it was trained and which an operator has rejected; None without one.
    """

    id: int
    jumped: tuple[str, ...] = ()
    defect: str = ""
    hindrance: str = ""
    drifted_with: str | None = None
    rejected: str | None = None


class LiveModel(WorkerThread):
    """Keeps the live model in memory; reading it never blocks.

    Args:
        table: the store's models.
        rig: the machine, as described by the present rig file.
        knows_jumps: returns False if the store is damaged so that it may not show an encoder's jump. No model is used
            then.
    """

    def __init__(self, table: ModelTable, rig: Rig, knows_jumps: Callable[[], bool] = lambda: True) -> None:
        super().__init__("live-model", STOP_TIMEOUT_S)
        self._table, self._rig, self.knows_jumps = table, rig, knows_jumps
        self._state: Loaded | Missing = Missing(LOADING)
        self._turn = threading.Lock()  # guards the state together with the mark that it is out of date
        self._changed = threading.Event()
        self._changed.set()
        self._is_void = False
        self._told = ""  # the last load error that was logged

    def stop(self) -> None:
        """Stop loading; wait at most `STOP_TIMEOUT_S` for a load in progress."""
        self._stopping.set()
        self._changed.set()
        super().stop()

    def now(self) -> Loaded | Missing:
        """Return the live model, or the reason why there is none; from any thread."""
        state = self._state
        is_unsafe = isinstance(state, Loaded) and not self.knows_jumps()
        return Missing(UNKNOWN_JUMPS, is_defect=True) if is_unsafe else state

    def health(self) -> LiveModelHealth | None:
        """Return the faults of the live model; None if no model is live."""
        run = self._table.live_run()
        if run is None:
            return None
        live, drifted = self.now(), self._table.drifted(run)
        drifted_with = None if drifted is None else drifted[1]
        if isinstance(live, Loaded):
            rejected = self._table.not_used(live.sessions, only_if_rejected=True)
            rejected_id = None if rejected is None else rejected[0]
            return LiveModelHealth(run.model_id, live.jumped, drifted_with=drifted_with, rejected=rejected_id)
        reason = live.reason if live.is_defect else ""
        defect, hindrance = ("", reason) if live.is_hindered else (reason, "")
        return LiveModelHealth(run.model_id, (), defect, hindrance, drifted_with)

    def changed(self) -> None:
        """Load again, because a different model has gone live or what is known of the joints' zeros has changed."""
        with self._turn:
            self._load_again()

    def jump_stored(self) -> None:
        """Load again after `void`, because the jump is stored."""
        with self._turn:
            self._is_void = False
            self._load_again()

    def _load_again(self) -> None:
        if not self._is_void:
            self._state = Missing(LOADING)
        self._changed.set()

    def void(self) -> None:
        """Use no model until `jump_stored` is called, because a jump of a joint's reading is not stored yet."""
        with self._turn:
            self._state, self._is_void = Missing(JUMPED), True

    def load(self, row: ModelRow) -> CalibratedModel:
        """Read a model of the store; a child process loaded it successfully when it was written.

        Raises:
            CalibrationError: the model is damaged, edited, or made for a different rig file; or this computer lacks
                something that loading needs.
        """
        from daemon.warm_up import prepare

        try:
            prepare()
        except OSError as error:
            raise CalibrationError(f"compiled code cannot be stored: {error}") from error
        from daemon.models.model_files import read_model_of_rig  # numerical packages take a second to import

        return read_model_of_rig(row.path, row.manifest_sha256, self._rig)

    def _run(self) -> None:
        wait_s: float | None = None
        while True:
            self._changed.wait(wait_s)
            self._changed.clear()
            if self._stopping.is_set():
                return
            state = self._look()
            wait_s = RETRY_S if isinstance(state, Missing) and state.is_defect else None
            with self._turn:
                if not self._changed.is_set() and not self._is_void:
                    self._state = state

    def _look(self) -> Loaded | Missing:
        try:
            row = self._table.live()
            if row is None:
                return Missing(NO_MODEL)
            jumped = tuple(name for name in self._table.jumped(row) if name in self._rig.joint_names)
            loaded = Loaded(row.id, self.load(row), jumped, self._table.time_axis(), row.sessions)
        except Exception as error:  # noqa: BLE001 - logged, and shown as the state
            if self._stopping.is_set():
                return Missing(LOADING)  # store and processes are being stopped: not a defect of the model
            return self._failed(error)
        self._told = ""
        log.info("model %d is live", row.id)
        return loaded

    def _failed(self, error: Exception) -> Missing:
        """Return the reason why the live model could not be loaded, and log it once."""
        is_hindered = not isinstance(error, ModelError | UnsafeError)
        if is_hindered:
            reason = f"the live model could not be loaded and will be retried: {str(error) or type(error).__name__}"
        else:
            reason = f"the live model cannot be used: {error}"
        if reason != self._told:
            log.error("%s", reason, exc_info=error if is_hindered else None)
        self._told = reason
        return Missing(reason, is_defect=True, is_hindered=is_hindered)
