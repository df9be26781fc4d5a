"""The installed service and the simulated rig before it, as an operator of the machine sees them."""

from __future__ import annotations

import contextlib
import json
import random
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.vm.image import PYTHON
from tests.vm.machine import ADAPTER, Answer, Machine, MachineError, wait_for

RIG = Path(__file__).with_name("rig.toml")
PLACE = "/etc/rigcal/loader.toml"
PLAN = "/etc/rigcal/plan.csv"
STORE = "/var/lib/rigcal/rigcal.sqlite"
LINKS = {"vcan": ("vcan0", "vcan0"), "cards": ("can0", "can1")}  # wiring -> where the service, and where the rig is
BUS, STATION = "boom", "station"
CONFIG = """rig = "{rig}"
read_group = "rigcal-read"

[[can]]
name = "boom"
channel = "{channel}"

[[station]]
profile = "topcon_gts8"
poll_interval_s = 0.5
serial.path = "/dev/rigcal-station"

[sessions]
fixes_per_shot = 3
"""
POSES, STAND_S = 60, 6.0


class Service:
    """rigcal as a systemd service, and `python -m simulators` at the other ends of its links.

    Args:
        machine: where both run.
    """

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self._wiring = ""

    # ---- set-up ------------------------------------------------------------------------------------------------------

    def install(self) -> None:
        """Do what deploy/README.md asks for after installing; the service is not started yet."""
        machine = self.machine
        rule = "/etc/udev/rules.d/99-rigcal-station.rules"
        machine.run(f"sed -i s/REPLACE-WITH-SERIAL/{ADAPTER}/ {rule} && udevadm control --reload")
        machine.run("udevadm trigger --subsystem-match=tty && udevadm settle && readlink -e /dev/rigcal-station")
        machine.write(PLACE, RIG.read_text(encoding="utf-8"))
        machine.write(PLAN, _plan())
        machine.run("ip link add dev vcan0 type vcan && ip link set vcan0 up")
        machine.run("systemctl enable --now systemd-networkd && networkctl reload")  # can0, as deploy/ has it
        machine.run("ip link set can1 type can bitrate 250000 && ip link set can1 txqueuelen 1000 up")

    def on(self, wiring: str) -> None:
        """Have the service listen and the rig send on `vcan` or on the pair of `cards`, and wait until it reads all."""
        if self._wiring == wiring:
            return
        heard, sent = LINKS[wiring]
        self.stop_rig()
        self.machine.write("/etc/rigcal/rigcal.toml", CONFIG.format(rig=PLACE, channel=heard))
        self.machine.run("systemctl restart rigcal", 900.0)
        self.start_rig(sent)
        self.wait_until_well()
        self._wiring = wiring

    def mend(self) -> None:
        """Put back what a check that failed may have left as it was, so that the next one has a chance."""
        self._wiring = ""
        self.machine.tried("ip link add dev vcan0 type vcan; ip link set vcan0 up")
        self.machine.tried("ip link set can0 up; ip link set can1 up; systemctl reset-failed")
        with contextlib.suppress(MachineError):  # it is plugged in
            self.machine.plug_adapter()

    def start_rig(self, channel: str) -> None:
        """Let the simulated rig drive its plan again and again; its station follows the prism."""
        options = f"--rig {PLACE} --seed 1 --can socketcan:{channel} --station-device /dev/ttyS1 --aim tip"
        options += f" --drive {PLAN} --loop --dwell-s {STAND_S:g} --speed 1 --sync-ms 100 --signal-ms 100"
        options += " --wire-log /run/rig.log"
        begin = f"exec 3<>/run/rig.commands; exec {PYTHON} -I -m simulators {options} <&3"
        self.machine.run("[ -p /run/rig.commands ] || mkfifo /run/rig.commands")
        self.machine.run(f"systemd-run -q --collect --unit=rig bash -c {shlex.quote(begin)}")

    def stop_rig(self) -> None:
        """Switch the simulated rig off."""
        self.machine.tried("systemctl stop rig")
        self._wiring = ""

    def pause_rig(self) -> int:
        """Let the simulated rig send nothing, and return how many of the bus's captures are stored once all are."""
        self.machine.run("systemctl kill -s STOP rig")
        seen = -1
        while seen != (now := self.stored()):
            seen = now
            self.machine.run("sleep 1")
        return seen

    def resume_rig(self) -> None:
        """Let it go on; it sends what it would have sent meanwhile."""
        self.machine.run("systemctl kill -s CONT rig")

    def aim(self, target: str) -> None:
        """Turn the station by hand."""
        line = json.dumps({"do": "aim", "target": target})
        self.machine.run(f"echo {shlex.quote(line)} > /run/rig.commands")

    # ---- questions ---------------------------------------------------------------------------------------------------

    def ask(self, command: str, **arguments: Any) -> Any:
        """Give the service a command; MachineError where it refuses."""
        answer = self.machine.ask(command, **arguments)
        if answer.error or not isinstance(answer.answer, dict) or not answer.answer["ok"]:
            raise MachineError(f"{command}: {answer.error or answer.answer}")
        return answer.answer["result"]

    def status(self) -> dict[str, Any] | None:
        """Return its state; None while it does not answer."""
        try:
            found = self.ask("status")
        except MachineError:
            return None
        return dict(found)

    def link(self, name: str = BUS) -> dict[str, Any]:
        """Return the state of a link."""
        status = self.ask("status")
        return next(dict(one) for one in status["acquisition"]["links"] if one["name"] == name)

    def alarm(self, kind: str) -> dict[str, Any] | None:
        """Return an alarm that stands."""
        return next((dict(one) for one in self.ask("alarms.list")["active"] if one["kind"] == kind), None)

    def wait_for_alarm(self, kind: str, *, stands: bool = True, within_s: float = 120.0) -> Any:
        """Wait until an alarm stands, or does no more."""
        what = f"alarm {kind} to {'stand' if stands else 'end'}"
        return self.wait(what, lambda: (self.alarm(kind) is not None) == stands, within_s) and self.alarm(kind)

    def wait(self, what: str, look: Callable[[], Any], within_s: float = 120.0, pause_s: float = 0.5) -> Any:
        """Return the first thing that `look` finds, looking every `pause_s` seconds of this computer's time."""
        return wait_for(self.machine, what, look, within_s, pause_s)

    def wait_until_well(self, within_s: float = 300.0) -> None:
        """Wait until all channels are read and the station is locked."""

        def is_well() -> bool:
            status = self.status()
            if status is None:
                return False
            acquisition = status["acquisition"]
            channels = all(one["status"] == "ok" for one in acquisition["channels"])
            return channels and all(one["lock"] == "locked" for one in acquisition["stations"])

        self.wait("all channels and a locked station", is_well, within_s)

    def query(self, sql: str, store: str = STORE) -> list[Any]:
        """Return the rows of a query of the store."""
        return self.machine.query(sql, store)

    def first_capture_s(self, since_s: float, link: str = BUS) -> float:
        """Return when the first capture of a link after an instant was made; waits until it is stored."""
        sql = f"""SELECT min(first_monotonic_ns) FROM raw_chunks WHERE first_monotonic_ns > {round(since_s * 1e9)}
            AND last_boot_id = (SELECT max(id) FROM boots) AND link_id = (SELECT id FROM links WHERE name = '{link}')"""
        return float(self.wait("a capture", lambda: self.query(sql)[0][0], 300.0)) / 1e9

    def stored(self, link: str = BUS) -> int:
        """Return how many captures of a link are in the store."""
        sql = "SELECT coalesce(sum(captures), 0) FROM raw_chunks JOIN links ON links.id = link_id WHERE name"
        return int(self.query(f"{sql} = '{link}'")[0][0])

    def counted(self, interface: str, what: str = "rx_packets") -> int:
        """Return what the kernel has counted at an interface."""
        return int(self.machine.run(f"cat /sys/class/net/{interface}/statistics/{what}"))

    def property(self, name: str) -> str:
        """Return what systemd says of the service."""
        return self.machine.run(f"systemctl show rigcal --value -p {name}").strip()

    def command_line(self, user: str, *words: str) -> Answer:
        """Give a command as a user types it."""
        return self.machine.tried(f"runuser -u {user} -- rigcal {shlex.join(words)}", 300.0)


def expect(holds: object, said: object) -> None:
    """End a check with what was said, if something does not hold."""
    if not holds:
        raise MachineError(str(said))


def _plan() -> str:
    rng = random.Random(1)
    rows = [
        f"{rng.uniform(-55, 55):.2f},{rng.uniform(-10, 55):.2f},{rng.uniform(50, 1450):.1f}\n" for _ in range(POSES)
    ]
    return "slew_deg,lift_deg,reach_mm\n" + "".join(rows)
