"""The live model and the operator's commands about models.

A candidate goes live only if it is significantly better than the live model on held-out sessions and an operator
accepts it. A first model must not be worse there than the nominal model. Any model that was live can be restored by a
rollback. Before a model goes live, its files are verified against their manifest, the manifest's checksum against the
store, and the model is loaded.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from calibration.errors import CalibrationError, ModelError, UnsafeError
from daemon.commands import REFUSED, CommandError, caller_columns, text_argument
from daemon.models.live_model import UNKNOWN_JUMPS, LiveModel
from daemon.store.queries.models import REJECTED, ModelRow, ModelTable

log = logging.getLogger(__name__)

_CANNOT = "model {} cannot go live: "
_Files = tuple[tuple[str, int, int], ...]


class ModelRegistry:
    """The commands about models.

    Args:
        table: the store's models.
        rig_name: rig whose models can go live.
        live: the model in use.
        compare: queues the comparison of a model with the live one, and returns a sentence about it.
        comparison_job: returns the pending job that will compare a model; None if there is none.
        comparison_after: returns the pending job that will compare the model which a later stage makes from a model,
            and the job that makes it; None if there is none.
        zeros_checked: stores the consequences of an operator's confirmation of the joints' zeros.
    """

    def __init__(
        self,
        table: ModelTable,
        rig_name: str,
        live: LiveModel,
        *,
        compare: Callable[[ModelRow], str],
        comparison_job: Callable[[ModelRow], int | None],
        comparison_after: Callable[[ModelRow], tuple[int, int] | None],
        zeros_checked: Callable[[], None] = lambda: None,
    ) -> None:
        self._table, self._rig, self._live = table, rig_name, live
        self._compare, self._comparison_job, self._comparison_after = compare, comparison_job, comparison_after
        self._zeros_checked = zeros_checked
        # Model -> the state of its files when it was last loaded for `status`, and why it cannot go live.
        self._loaded: dict[int, tuple[_Files, str | None]] = {}

    # ---- commands of the operator ------------------------------------------------------------------------------------

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return all models, oldest first."""
        live = self._table.live()
        return [self._brief(model, live) for model in self._table.all()]

    def show_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return a model, by default the live one, with its comparison and all changes of its state."""
        model = self._wanted(arguments)
        return model.as_dict() | {"history": self._table.history(model)}

    def compare_command(self, arguments: Mapping[str, Any]) -> str:
        """Compare a model with the present live model, on all check sessions."""
        return self._compare(self._own(self._table.get(arguments.get("id"))))

    def accept_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Make a candidate the live model, if it was better on held-out sessions."""
        model = self._own(self._table.get(arguments.get("id")))
        if model.state != "candidate":
            is_back = model.state == "retired" and self._table.was_live(model)
            also = f"; `rigcal model rollback {model.id}` makes it live again" if is_back else ""
            raise CommandError(f"model {model.id} is {model.state}; only a candidate can be accepted{also}")
        live = self._table.live()
        reason = self._reason_to_accept(model, live)
        self._make_live(model, live, arguments, f"accepted: {reason}")
        return self._changed(model, live) | {"reason": reason}

    def reject_command(self, arguments: Mapping[str, Any]) -> str:
        """Retire a candidate, so that nobody accepts it by mistake, or the live model, so that there is no tip from it.

        The reason is stored. No other model takes the place of a live one by itself.
        """
        model = self._own(self._table.get(arguments.get("id")))
        reason = text_argument(arguments, "reason").strip()
        if not reason:
            raise CommandError(f"give a reason for rejecting model {model.id}; it is stored with the model")
        operator = text_argument(arguments, "operator")
        if not self._table.reject(model, f"{REJECTED}{reason}", operator=operator, **caller_columns()):
            state = self._table.get(model.id).state
            raise CommandError(f"model {model.id} is {state}; only a candidate or the live model can be rejected")
        log.warning("model %d was rejected by %s: %s", model.id, operator or "an unnamed operator", reason)
        if model.state == "candidate":
            return f"model {model.id} is rejected"
        self._live.changed()
        told = f"model {model.id} is rejected; no model is live now, and there is no corrected position"
        good = self._to_put_back()
        return told if good is None else f"{told}; `rigcal model rollback {good}` puts model {good} back"

    def rollback_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Make the predecessor of the live model live again, or any other model that was live before."""
        live = self._table.live()
        wanted = arguments.get("id")
        if wanted is None:
            wanted = None if live is None else self._table.predecessor(live)
            if wanted is None:
                none = f"model {live.id} replaced no other one when it went live" if live else "no model is live"
                raise CommandError(f"{none}; {self._instead()}")
        model = self._own(self._table.get(wanted))
        if model.state != "retired" or not self._table.was_live(model):
            why = {
                "live": "is already live",
                "candidate": "was never live; `rigcal model accept` makes it live",
                "retired": "was rejected and never live",
            }[model.state]
            raise CommandError(f"model {model.id} {why}")
        doubts = [] if (rejection := self._table.rejection(model)) is None else [f"it had been {rejection}"]
        if (unused := self._table.not_used(model.sessions)) is not None:
            doubts.append(f"it was trained on {_not_used(*unused)}")
        self._make_live(model, live, arguments, "put back")
        return self._changed(model, live) | ({"reason": f"note that {'; '.join(doubts)}"} if doubts else {})

    def zeros_checked_command(self, arguments: Mapping[str, Any]) -> str:
        """Record the operator's confirmation that the joints' zeros are those that a model was trained with.

        The model is the live model, or the newest candidate if none is live.
        """
        model = self._table.live() or self._table.waiting()
        if model is None:
            raise CommandError(
                "there is no model yet whose zeros could be confirmed; `rigcal session accept ID` confirms for a "
                "session that it was measured with the present zeros"
            )
        if not self._live.knows_jumps():
            raise CommandError(f"no jump can be ignored: {UNKNOWN_JUMPS}", REFUSED)
        jumped = self._table.jumped(model)
        operator = text_argument(arguments, "operator")
        through = max(jumped.values(), default=0)
        with self._table.at_once():
            self._table.note_zeros_checked(model, through, operator=operator, **caller_columns())
            self._zeros_checked()
        self._live.changed()
        told = f"earlier jumps are now ignored: {', '.join(jumped) or 'there were none'}"
        return f"model {model.id} is in use again; {told}" if model.state == "live" else f"model {model.id}: {told}"

    def status(self) -> dict[str, Any]:
        """Return the live model, the newest candidate and, without a live model, the one to put back, for `status`."""
        live, waiting = self._table.live(), self._table.waiting()
        return {
            "live": live and self._brief(live, live),
            "candidate": waiting and self._candidate(waiting, live),
            "to_put_back": self._to_put_back() if live is None else None,
        }

    def _candidate(self, model: ModelRow, live: ModelRow | None) -> dict[str, Any]:
        """Return a candidate, with whether `accept_command` would accept it now and, if not, the reason.

        Returns:
            Also `is_outdated`: whether it was trained on a session that is not used any more, so no check can help it.
        """
        refusal: str | None = None
        try:
            self._reason_to_accept(model, live)
            self._require_loads(model)
        except CommandError as error:
            refusal = str(error).removeprefix(_CANNOT.format(model.id))  # `status` names the model already
        told = {"is_acceptable": refusal is None, "refused_because": refusal}
        return self._brief(model, live) | told | {"is_outdated": self._table.not_used(model.sessions) is not None}

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _formerly_live(self) -> list[ModelRow]:
        """Return the rig's retired models that were live, the newest first."""
        models = [model for model in self._table.all() if model.rig == self._rig and model.state == "retired"]
        return [model for model in reversed(models) if self._table.was_live(model)]

    def _to_put_back(self) -> int | None:
        """Return the newest model that was live and is neither rejected nor of a session that is; None without one."""
        good = (
            m for m in self._formerly_live() if not self._table.rejection(m) and not self._table.not_used(m.sessions)
        )
        return next((model.id for model in good), None)

    def _instead(self) -> str:
        """Return what to do where there is no predecessor to roll back to."""
        if (good := self._to_put_back()) is not None:
            return f"name one, as `rigcal model rollback {good}`"
        if others := self._formerly_live():
            why = self._table.rejection(others[0]) or "trained on a session that is not used any more"
            return f"accept a better model, or name one: model {others[0].id} was live, but is {why}"
        return "accept a better model"

    def _wanted(self, arguments: Mapping[str, Any]) -> ModelRow:
        if arguments.get("id") is not None:
            return self._table.get(arguments["id"])
        live = self._table.live()
        if live is None:
            raise CommandError("no model is live; give the number of a model from `rigcal model list`")
        return live

    def _own(self, model: ModelRow) -> ModelRow:
        if model.rig != self._rig:
            raise CommandError(f"model {model.id} is of rig {model.rig!r}, but this is rig {self._rig!r}", REFUSED)
        return model

    def _make_live(self, model: ModelRow, live: ModelRow | None, arguments: Mapping[str, Any], reason: str) -> None:
        operator = text_argument(arguments, "operator")
        self._load(model)
        if not self._table.go_live(model, live, reason, operator=operator, **caller_columns()):
            raise CommandError(
                "models or sessions were changed in the meantime by another command or by a comparison; check "
                "`rigcal model list`",
                REFUSED,
            )
        log.warning("model %d was made live by %s: %s", model.id, operator or "an unnamed operator", reason)
        self._live.changed()

    def _load(self, model: ModelRow) -> None:
        try:
            self._live.load(model)
        except CalibrationError as error:
            raise CommandError(f"{_CANNOT.format(model.id)}{error}", REFUSED) from error

    def _require_loads(self, model: ModelRow) -> None:
        """Do as `_load`, which takes a second, but only once for the same state of the model's files."""
        files = _files(model.path)
        seen, refusal = self._loaded.get(model.id, (None, None))
        if seen != files:
            refusal = None
            try:
                self._load(model)
            except CommandError as error:
                if not isinstance(error.__cause__, ModelError | UnsafeError):
                    raise  # the computer's fault, as when memory is short: the next time it may load
                refusal = str(error)
            self._loaded[model.id] = files, refusal
        if refusal is not None:
            raise CommandError(refusal, REFUSED)

    def _reason_to_accept(self, model: ModelRow, live: ModelRow | None) -> str:
        """Return the reason why a candidate may go live; raise CommandError (REFUSED) if it may not."""
        if (unused := self._table.not_used(model.sessions)) is not None:
            raise CommandError(f"{_CANNOT.format(model.id)}it was trained on {_not_used(*unused)}", REFUSED)
        compared = model.comparison
        stale = None if compared is None else self._why_stale(compared, live)
        again = f"; `rigcal model compare {model.id}` compares it{'' if compared is None else ' again'}"
        if (compared is None or stale) and (job := self._comparison_job(model)) is not None:
            again = f"; wait for job {job}, which will compare it"
        elif compared is None and (later := self._comparison_after(model)) is not None:
            job, maker = later
            again = f"; wait for job {job}, which will compare the model that job {maker} makes of the same sessions"
        elif compared is None or self._why_unchecked(compared):
            again = f": hold a check session (`rigcal session start --kind check`){again}"
        if compared is None:
            raise CommandError(f"model {model.id} was not compared on held-out data yet{again}", REFUSED)
        if stale:
            raise CommandError(f"model {model.id} was compared {stale}{again}", REFUSED)
        if not compared["is_better"]:
            raise CommandError(f"{_CANNOT.format(model.id)}{compared['sentence']}", REFUSED)
        return str(compared["sentence"])

    def _why_stale(self, compared: Mapping[str, Any], live: ModelRow | None) -> str | None:
        """Return with what or on what a model was compared, a clause, if that does not count any more; else None."""
        if compared["live"] != (live and live.id):
            now = f"model {live.id} is live now" if live else "none is live now"
            then = "no model was live" if compared["live"] is None else f"model {compared['live']} was live"
            return f"when {then}, but {now}"
        if live is not None and compared.get("live_was_unreadable") and self._loads(live):
            return f"when the files of model {live.id} could not be read, but now they can"
        return self._why_unchecked(compared)

    def _why_unchecked(self, compared: Mapping[str, Any]) -> str | None:
        """Return on which check session a model was compared, a clause, if none or one that is not used; else None."""
        checks = compared.get("sessions")
        if checks is None:  # not noted
            return None
        if not checks:
            return "on no check session, as none holds fixes that neither model was trained on"
        unused = self._table.not_used(checks)
        return None if unused is None else f"on {_not_used(*unused)}"

    def _loads(self, model: ModelRow) -> bool:
        try:
            self._require_loads(model)
        except CommandError:
            return False
        return True

    def _brief(self, model: ModelRow, live: ModelRow | None) -> dict[str, Any]:
        compared = model.comparison
        stale = self._why_stale(compared, live) if compared and model.state == "candidate" else None
        return {
            "id": model.id,
            "rig": model.rig,
            "state": model.state,
            "stage": model.stage,
            "created_utc_ns": model.created_utc_ns,
            "path": str(model.path),
            "sessions": len(model.sessions),
            "comparison": compared
            and {
                **{key: compared[key] for key in ("live", "is_better", "sentence")},
                "is_stale": stale is not None,
                "stale_because": stale,
            },
        }

    def _changed(self, model: ModelRow, live: ModelRow | None) -> dict[str, Any]:
        return {"live": model.id, "retired": live and live.id, "path": str(model.path)}


def _not_used(session_id: str, why: str) -> str:
    return f"session {session_id}, which calibration does not use any more ({why})"


def _files(directory: Path) -> _Files:
    """Return name, size and modification time of a model's files; empty if they cannot be listed."""
    try:
        return tuple(sorted((e.name, e.stat().st_size, e.stat().st_mtime_ns) for e in os.scandir(directory)))
    except OSError:
        return ()
