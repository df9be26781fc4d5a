"""`rigcal run` on a rig that another process simulates: `python -m tests.soak.rig_daemon CONFIG RATE ORIGIN OPERATOR`.

Everything is as on a real rig but the clock, which is the simulation's, and the operator's hand at the station, which
is asked at the socket OPERATOR to aim.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

from daemon import composition
from daemon.cli.main import main
from daemon.control.protocol import request
from drivers.clock import ScaledClock, Stamp


def run(config: str, rate: str, origin: str, operator: str) -> None:
    utc_ns, monotonic_ns, boot_id = origin.split(",", 2)
    clock = ScaledClock(float(rate), Stamp(int(utc_ns), int(monotonic_ns), boot_id))

    def aim(target: str) -> None:
        request(Path(operator), "aim", {"target": target})

    vars(composition)["live"] = partial(composition.live, clock=clock, aim=aim)
    main(["run", "--config", config])


if __name__ == "__main__":
    run(*sys.argv[1:])
