"""Commands of the daemon that the page may send, and the role that each needs.

A browser can send no other command: it cannot set up devices, delete from the store, decode the store again, or drive
a simulated boom.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from daemon.web.access import Role

COMMANDS: Mapping[str, Role] = MappingProxyType(
    {
        **dict.fromkeys(
            (
                "alarms.list",
                "guide.state",
                "jobs.list",
                "model.list",
                "model.show",
                "rig.show",
                "session.list",
                "session.show",
                "setup.list",
                "status",
                "tip",
            ),
            Role.READ,
        ),
        **dict.fromkeys(
            (
                "guide.done",
                "guide.more",
                "guide.skip",
                "guide.start",
                "guide.stop",
                "jobs.cancel",
                "jobs.retry",
                "model.compare",
                "session.abort",
                "session.confirm-prism",
                "session.shoot",
                "session.start",
                "session.stop",
                "setup.new",
            ),
            Role.OPERATE,
        ),
        **dict.fromkeys(
            ("model.accept", "model.reject", "model.rollback", "model.zeros-checked", "session.accept"),
            Role.APPROVE,
        ),
    }
)
TIMEOUTS_S: Mapping[str, float] = MappingProxyType({"session.shoot": 300.0, "guide.done": 300.0, "guide.start": 120.0})
TIMEOUT_S = 60.0
