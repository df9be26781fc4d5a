"""Commands that change what the store keeps: the same in the daemon, and where none runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

from daemon.acquisition.redecoding import redecode
from daemon.commands import FAILED, CommandError, caller_has_left, number_argument
from daemon.store import Store
from daemon.store.full_samples import stretches_between, stretches_of_session
from daemon.store.housekeeping import Housekeeping
from drivers.clock import NS_PER_S
from drivers.readings import Decoder

LEAST_DAYS = 1.0
_DAY_NS = 86_400 * NS_PER_S


def go_on_for_caller() -> None:
    """Raise CommandError if nobody waits any more for the command that this thread carries out."""
    if caller_has_left():
        raise CommandError("given up, as nobody waits for it any more; what was done until then stays", FAILED)


def prune(
    housekeeping: Housekeeping, arguments: Mapping[str, Any], now_utc_ns: int, go_on: Callable[[], None]
) -> dict[str, Any]:
    """Delete captures and readings outside sessions that are older than `days`.

    Args:
        housekeeping: of the store.
        arguments: `days`.
        now_utc_ns: the present.
        go_on: called between steps; what it raises ends the work.
    """
    days = number_argument(arguments, "days")
    if days is None or days < LEAST_DAYS:
        raise CommandError(f"days must be {LEAST_DAYS:g} or more, not {days!r:.80}")
    newest_ns = housekeeping.prune(now_utc_ns - round(days * _DAY_NS), go_on)
    return {"deleted_until_utc_ns": newest_ns}


def redecode_command(
    store: Store,
    decoders: Mapping[str, Callable[[], Decoder]],
    arguments: Mapping[str, Any],
    go_on: Callable[[], None],
) -> dict[str, Any]:
    """Make all readings and fixes of a session, or of some time, again from raw captures.

    Args:
        store: open for writing.
        decoders: link -> what makes its decoder.
        arguments: `session`, or `first_utc_ns` and `last_utc_ns`.
        go_on: called again and again; what it raises ends the work, and what was stored stays.
    """
    with store.reader() as reader:
        if session := arguments.get("session"):
            stretches = stretches_of_session(reader, str(session))
            what = f"session {str(session)!r:.80}"
        else:
            first_ns, last_ns = arguments.get("first_utc_ns"), arguments.get("last_utc_ns")
            if not isinstance(first_ns, int) or not isinstance(last_ns, int) or first_ns >= last_ns:
                raise CommandError("give a session, or a time whose end is later than its begin")
            stretches = stretches_between(reader, first_ns, last_ns)
            what = f"the time from {_text(first_ns)} to {_text(last_ns)}"
    if not stretches:
        raise CommandError(f"the store has no captures of {what}; `rigcal session list` shows the sessions")
    added = redecode(store, decoders, stretches, go_on)
    return {
        "added": added,
        "stretches": [{"first_utc_ns": first.utc_ns, "last_utc_ns": last.utc_ns} for first, last in stretches],
    }


def _text(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"
