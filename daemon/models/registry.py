"""Which model is live, and the operator's commands about it.

A candidate goes live only when it beats the live model on held-out sessions beyond chance and an operator accepts it;
a first model must not be worse there than the nominal one. Any model that was live can be put back. Before either, the
model's files are checked against their manifest, and its sum against the store, and it is loaded.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from calibration.errors import CalibrationError, ModelError, UnsafeError
from daemon.commands import REFUSED, CommandError, caller_columns, text_argument
from daemon.models.live_model import LiveModel
from daemon.store.queries.models import ModelRow, ModelTable

log = logging.getLogger(__name__)

_Files = tuple[tuple[str, int, int], ...]


class ModelRegistry:
    """The commands about models.

    Args:
        table: the store's models.
        rig_name: whose models go live.
        live: the model in use.
        compare: queues the comparison of a model with the live one, and says so.
        comparison_job: tells the job that is yet to compare a model; None without one.
        comparison_after: tells the job that is yet to compare the model which a later stage makes of a model, and the
            job that makes it; None without one.
        zeros_checked: stores what follows from an operator's word about the joints' zeros.
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
        # The candidate that was last loaded for `status`, its files as they lay there, and why it cannot go live.
        self._loaded: tuple[tuple[int, _Files], str | None] | None = None

    # ---- commands of the operator ------------------------------------------------------------------------------------

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """All models, oldest first."""
        live = self._table.live()
        return [_brief(model, live) for model in self._table.all()]

    def show_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """One model, the live one by default, with its comparison and every change of its state."""
        model = self._wanted(arguments)
        return model.as_dict() | {"history": self._table.history(model)}

    def compare_command(self, arguments: Mapping[str, Any]) -> str:
        """Compare a model with the one that is live now, on all check sessions."""
        return self._compare(self._own(self._table.get(arguments.get("id"))))

    def accept_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Make a candidate the live model, if it has shown on held-out sessions that it is better."""
        model = self._own(self._table.get(arguments.get("id")))
        if model.state != "candidate":
            is_back = model.state == "retired" and self._table.was_live(model)
            also = f"; `rigcal model rollback {model.id}` puts it back" if is_back else ""
            raise CommandError(f"model {model.id} is {model.state}; only a candidate can be accepted{also}")
        live = self._table.live()
        reason = self._reason_to_accept(model, live)
        self._make_live(model, live, arguments, f"accepted: {reason}")
        return self._changed(model, live) | {"reason": reason}

    def reject_command(self, arguments: Mapping[str, Any]) -> str:
        """Retire a candidate, so that nobody accepts it by mistake; the reason is kept."""
        model = self._own(self._table.get(arguments.get("id")))
        reason = text_argument(arguments, "reason").strip()
        if not reason:
            raise CommandError(f"say why model {model.id} is rejected: the reason is kept with it")
        operator = text_argument(arguments, "operator")
        if model.state != "candidate" or not self._table.reject(
            model, f"rejected: {reason}", operator=operator, **caller_columns()
        ):
            raise CommandError(f"model {model.id} is {self._table.get(model.id).state}; only a candidate is rejected")
        log.warning("model %d is rejected (%s), by %s", model.id, reason, operator or "an operator without a name")
        return f"model {model.id} is rejected"

    def rollback_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Put back the model that the live one replaced, or any other that was live."""
        live = self._table.live()
        wanted = arguments.get("id")
        if wanted is None:
            if live is None:
                raise CommandError("no model is live, so none can be rolled back; `rigcal model list` shows all")
            wanted = self._table.predecessor(live)
            if wanted is None:
                others = [m.id for m in self._table.all() if m.state == "retired" and self._table.was_live(m)]
                instead = f"name another, as `rigcal model rollback {others[-1]}`" if others else "accept a better one"
                raise CommandError(f"model {live.id} is the first that went live, and replaced none; {instead}")
        model = self._own(self._table.get(wanted))
        if model.state != "retired" or not self._table.was_live(model):
            why = {
                "live": "is live already",
                "candidate": "was never live; `rigcal model accept` makes it so",
                "retired": "was rejected, and never live",
            }[model.state]
            raise CommandError(f"model {model.id} {why}")
        self._make_live(model, live, arguments, "put back")
        return self._changed(model, live)

    def zeros_checked_command(self, arguments: Mapping[str, Any]) -> str:
        """Take the operator's word that the joints' zeros are those that a model was trained with.

        It is the live one, or, where none is, the newest that waits to be accepted.
        """
        model = self._table.live() or self._table.waiting()
        if model is None:
            raise CommandError(
                "there is no model yet whose zeros they could be; `rigcal session accept ID` says of each session that "
                "it was measured with the present ones"
            )
        jumped = self._table.jumped(model)
        operator = text_argument(arguments, "operator")
        through = max(jumped.values(), default=0)
        with self._table.at_once():
            self._table.note_zeros_checked(model, through, operator=operator, **caller_columns())
            self._zeros_checked()
        self._live.changed()
        told = f"jumps until now count no more: {', '.join(jumped) or 'there were none'}"
        return f"model {model.id} is used again; {told}" if model.state == "live" else f"model {model.id}: {told}"

    def status(self) -> dict[str, Any]:
        """Return the live model, and the newest candidate that waits to be accepted, for `status`."""
        live, waiting = self._table.live(), self._table.waiting()
        return {"live": live and _brief(live, live), "candidate": waiting and self._candidate(waiting, live)}

    def _candidate(self, model: ModelRow, live: ModelRow | None) -> dict[str, Any]:
        """A model that waits, with whether `accept_command` would take it now, and why it would not."""
        refusal: str | None = None
        try:
            self._reason_to_accept(model, live)
            self._require_loads(model)
        except CommandError as error:
            refusal = str(error)
        return _brief(model, live) | {"is_acceptable": refusal is None, "refused_because": refusal}

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _wanted(self, arguments: Mapping[str, Any]) -> ModelRow:
        if arguments.get("id") is not None:
            return self._table.get(arguments["id"])
        live = self._table.live()
        if live is None:
            raise CommandError("no model is live; name one by its number, `rigcal model list` shows them")
        return live

    def _own(self, model: ModelRow) -> ModelRow:
        if model.rig != self._rig:
            raise CommandError(f"model {model.id} is of rig {model.rig!r}, and this is rig {self._rig!r}", REFUSED)
        return model

    def _make_live(self, model: ModelRow, live: ModelRow | None, arguments: Mapping[str, Any], reason: str) -> None:
        operator = text_argument(arguments, "operator")
        self._load(model)
        if not self._table.go_live(model, live, reason, operator=operator, **caller_columns()):
            raise CommandError(
                "another command or comparison changed the models meanwhile; look again with `rigcal model list`",
                REFUSED,
            )
        log.warning("model %d is live (%s), by %s", model.id, reason, operator or "an operator without a name")
        self._live.changed()

    def _load(self, model: ModelRow) -> None:
        try:
            self._live.load(model)
        except CalibrationError as error:
            raise CommandError(f"model {model.id} cannot go live: {error}", REFUSED) from error

    def _require_loads(self, model: ModelRow) -> None:
        """As `_load`, which takes a second, but once for the model's files as they lie there."""
        files = model.id, _files(model.path)
        loaded = self._loaded
        if loaded is None or loaded[0] != files:
            refusal = None
            try:
                self._load(model)
            except CommandError as error:
                if not isinstance(error.__cause__, ModelError | UnsafeError):
                    raise  # the computer's fault, as when memory is short: the next time it may load
                refusal = str(error)
            self._loaded = loaded = files, refusal
        if loaded[1] is not None:
            raise CommandError(loaded[1], REFUSED)

    def _reason_to_accept(self, model: ModelRow, live: ModelRow | None) -> str:
        """Why a candidate may go live; CommandError, refused, where it may not."""
        compared = model.comparison
        is_stale = compared is not None and _is_stale(compared, live)
        again = f"; `rigcal model compare {model.id}` compares it anew"
        if (compared is None or is_stale) and (job := self._comparison_job(model)) is not None:
            again = f"; job {job} is yet to compare it: wait for that job"
        elif compared is None and (later := self._comparison_after(model)) is not None:
            job, maker = later
            again = f"; job {job} compares the model that job {maker} makes of the same sessions: wait for that one"
        elif compared is None:
            again = f": hold a check session (`rigcal session start --kind check`){again}"
        if compared is None:
            raise CommandError(f"model {model.id} was not compared with held-out data yet{again}", REFUSED)
        if is_stale:
            now = f"model {live.id} is live now" if live else "none is live now"
            then = "no model was live" if compared["live"] is None else f"model {compared['live']} was live"
            raise CommandError(f"model {model.id} was compared when {then}, and {now}{again}", REFUSED)
        if not compared["is_better"]:
            raise CommandError(f"model {model.id} does not go live: {compared['sentence']}", REFUSED)
        return str(compared["sentence"])

    def _changed(self, model: ModelRow, live: ModelRow | None) -> dict[str, Any]:
        return {"live": model.id, "retired": live and live.id, "path": str(model.path)}


def _is_stale(compared: Mapping[str, Any], live: ModelRow | None) -> bool:
    """True if a comparison is with another model than the one that is live."""
    return bool(compared["live"] != (live and live.id))


def _files(directory: Path) -> _Files:
    """Name, size and time of change of a model's files; nothing where they cannot be looked at."""
    try:
        return tuple(sorted((e.name, e.stat().st_size, e.stat().st_mtime_ns) for e in os.scandir(directory)))
    except OSError:
        return ()


def _brief(model: ModelRow, live: ModelRow | None) -> dict[str, Any]:
    compared = model.comparison
    waits = model.state == "candidate"
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
            "is_stale": waits and _is_stale(compared, live),
        },
    }
