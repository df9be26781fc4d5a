"""What people are told of a session that calibration does not use."""

from __future__ import annotations

from daemon.rig_files import HOW_TO_READ_AGAIN
from daemon.store.queries.sessions import OTHER_RIG_FILE


def not_used(session_id: str, reason: str) -> str:
    """Return a sentence on a closed session that calibration does not use, with what to do.

    Args:
        session_id: the session.
        reason: why it is not used, a clause.
    """
    accept = f"to use it anyway: `rigcal session accept {session_id}`"
    remedy = HOW_TO_READ_AGAIN if reason.startswith(OTHER_RIG_FILE) else accept
    return f"calibration does not use this session: {reason}; {remedy}"
