"""Every fault of the simulators, and of the world around them, at random times; and what must show each.

Faults of one lane come one after the other, those of different lanes as they fall.
"""

from __future__ import annotations

import contextlib
import json
import random
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from calibration.rig.channels import Cia404Analogue, Cia406Encoder, Cia406Linear
from calibration.rig.description import Rig
from drivers.clock import NS_PER_S
from tests.soak.daemon_process import DaemonProcess
from tests.soak.evidence import Blackout, Case, Expected, Watch
from tests.soak.rig_process import DIAGNOSED, RigProcess

LINK, STATION = "boom", "station"
CLOSES_S = 4.0  # a connection whose client has gone
AFTERWARDS_S = 6.0  # after a blackout, until faults can be seen again

_GOES_ON = Expected("fix", after_s=0.5)  # cleared: records come as before, from a station that turns without a distance
_ALARM = Expected("alarm")

# What shows a fault: any one of these. `daemon` and `store` are subjects of the program itself.
EVIDENCE: dict[str, tuple[Expected, ...]] = {
    "lock_loss": (Expected("event", ("lock_lost",)), Expected("gap", ("lock_lost",)), _ALARM),
    "prism_jump": (Expected("event", ("prism_jump",)), _ALARM),
    "bad_check": (Expected("failure"), _ALARM),
    "dropped_ack": (_GOES_ON, Expected("event", ("instrument_error", "station_silent")), _ALARM),
    "joined_buffers": (Expected("failure"), _GOES_ON, _ALARM),
    "clutter": (Expected("failure"), _GOES_ON, _ALARM),
    "station_silent": (Expected("event", ("station_silent",)), Expected("gap", ("silent",)), _ALARM),
    "node_silent": (Expected("event", ("heartbeat_lost",)), Expected("gap", ("silent",)), _ALARM),
    "node_reboot": (Expected("event", ("boot_up",)), _ALARM),
    "emergency": (Expected("event", ("emergency",)), _ALARM),
    "emergency_clear": (Expected("event", ("emergency_cleared",)),),
    "alarm": (Expected("event", ("alarm", "emergency")), _ALARM),
    "warning": (Expected("event", ("warning",)), _ALARM),
    "preset_jump": (Expected("event", ("preset_jump",)), Expected("reading", ("out_of_range",)), _ALARM),
    "preset_jump behind an alarm": (Expected("event", ("preset_jump",)),),
    "counter_gap": (Expected("missed"), Expected("gap", ("frames_lost",)), _ALARM),
    "not_available": (Expected("reading", ("not_available",)), _ALARM),
    "bus_error": (
        Expected("event", ("bus_error_warning", "bus_error_passive", "bus_off", "bus_error", "bus_error_active")),
        _ALARM,
    ),
    "unplug can": (Expected("event", ("link_lost",)), Expected("gap", ("link_down",)), _ALARM),
    "unplug station": (Expected("event", ("link_lost",)), Expected("gap", ("link_down",)), _ALARM),
    "daemon held": (
        Expected("event", ("frames_dropped", "time_doubtful")),
        Expected("gap", ("frames_lost", "time_doubtful")),
        _ALARM,
    ),
    "daemon killed": (Expected("gap", ("not_running",), subject="daemon"),),
    "store not writable": (Expected("error", subject="store"), Expected("alarm", subject="store")),
    "clients that hang": (Expected("answer", subject="daemon"),),
    # How long it takes until all is well again: told, and no bar
    "can back": (Expected("event", ("link_up",)),),
    "station back": (Expected("event", ("link_up",)),),
    "store writable again": (Expected("well", subject="store"),),
    "station speaks again": (Expected("fix"),),
    "node speaks again": (Expected("reading", ("ok",)),),
}
# What alarm must stand while a fault lasts, where it lasts for long.
ALARMS: dict[str, tuple[str, ...]] = {
    "lock_loss": ("station_not_locked",),
    "prism_jump": ("prism_jump",),
    "station_silent": ("station_silent",),
    "node_silent": ("joint_silent", "signal_silent", "heartbeat_lost"),
    "emergency": ("emergency",),
    "alarm": ("joint_not_usable", "signal_not_usable", "device_alarm", "emergency"),
    "warning": ("device_warning",),
    "not_available": ("signal_not_usable",),
    "bus_error": ("bus_error_passive",),
    "unplug can": ("link_down",),
    "unplug station": ("link_down",),
    "store not writable": ("not_storing",),
}
LONG_S = 10.0
STATION_FAULTS = (
    "lock_loss",
    "prism_jump",
    "bad_check",
    "dropped_ack",
    "joined_buffers",
    "clutter",
    "station_silent",
    "unplug",
)
RECOVERIES = ("can back", "station back", "store writable again", "station speaks again", "node speaks again")


@dataclass
class Lane:
    """Faults that come one after the other.

    Attributes:
        name: of the lane.
        pause_s: mean time from the end of one to the next, rig seconds.
        inject: makes one, lasts as long as it does.
    """

    name: str
    pause_s: float
    inject: Callable[[], None]


class Mischief:
    """Makes faults.

    Args:
        machine: the rig's description.
        rig, daemon: who suffers.
        watch: is told what to expect.
        seed: when what happens.
        density: how much denser than usual.

    Attributes:
        blackouts: when faults could not be seen.
        hanging: how many clients that hang are connected.
    """

    def __init__(
        self, machine: Rig, rig: RigProcess, daemon: DaemonProcess, watch: Watch, seed: int, density: float
    ) -> None:
        self._rig, self._daemon, self._watch = rig, daemon, watch
        self._rng = random.Random(seed)
        self._density = density
        self._stop = threading.Event()
        self._process = threading.Lock()  # what is done to the daemon's process comes one after the other
        self.blackouts: list[Blackout] = []
        self.hanging = 0
        on_bus = [c for c in machine.channels if isinstance(c, Cia406Encoder | Cia406Linear | Cia404Analogue)]
        self._nodes = {channel.node: (channel.name,) for channel in on_bus}
        self._positions = {c.node for c in on_bus if not isinstance(c, Cia404Analogue)}
        self._joints = {c.node for c in on_bus if c.name in machine.joint_names}
        self._encoders = {c.node for c in on_bus if isinstance(c, Cia406Encoder)}
        numbered = {channel.name for channel in on_bus}
        self._signals = tuple(c.name for c in machine.channels if c.name not in numbered)
        self._prisms = machine.prism_names
        self._lanes = (
            Lane("station", 5.0, self._station_fault),
            Lane("node", 4.0, self._node_fault),
            Lane("signals", 10.0, self._signal_fault),
            Lane("bus", 16.0, self._bus_fault),
            Lane("daemon", 50.0, self._daemon_fault),
            Lane("clients", 20.0, self._client_fault),
        )

    def run(self, stop: threading.Event) -> None:
        """Make faults until `stop`; ends when all of them have ended."""
        self._stop = stop
        threads = [threading.Thread(target=self._follow, args=(lane,), name=lane.name) for lane in self._lanes]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def kill_daemon(self) -> None:
        """Kill the daemon, and start it again."""
        with self._process:
            begin_ns = self._rig.now_ns()
            self._daemon.kill()
            self._rig.clock.wait(self._stop, 4 * self._rng.random())
            self._daemon.start()
            self._blackout("*", begin_ns)
            # Looked for from the moment that it answers, and not before: then it must know.
            self._expect("daemon killed", ("daemon",), "", at_ns=self._rig.now_ns())

    # ---- lanes -------------------------------------------------------------------------------------------------------

    def _follow(self, lane: Lane) -> None:
        while not self._wait(self._rng.expovariate(self._density / lane.pause_s)):
            lane.inject()

    def _station_fault(self) -> None:
        kind = self._rng.choice(STATION_FAULTS)
        lasts_s = self._rng.uniform(2.0, 16.0)
        if kind == "unplug":
            self._unplug("station", STATION, lasts_s)
            return
        given: dict[str, float | str] = {}
        if kind in ("lock_loss", "station_silent"):
            lasts_s = max(lasts_s, 2.0 if kind == "lock_loss" else 6.0)  # shorter ones leave no trace, and no harm
            given = {"seconds": lasts_s}
        elif kind == "prism_jump":
            if not self._watch.has_session or self._rig.aimed not in self._prisms or not self._rig.has_settled():
                return  # only a session has a prism that the station can leave, once it has been seen on it
            given = {"to": self._rng.choice([p for p in self._prisms if p != self._rig.aimed])}
        self._fault(kind, (STATION,), STATION, **given)
        if kind in ALARMS and (kind != "lock_loss" or self._watch.has_session):
            self._expect_alarm(kind, (STATION,), STATION, lasts_s)
        self._wait(lasts_s)
        if kind == "station_silent":
            self._expect("station speaks again", (STATION,), STATION)
        # The operator aims anew; after a loss of lock the station may as well have found something itself.
        if kind == "prism_jump" or (kind == "lock_loss" and self._rng.random() < 0.5):
            self._rig.aim_again()
        self._wait(8.0)

    def _node_fault(self) -> None:
        kind = self._rng.choice(
            (
                "node_silent",
                "node_reboot",
                "emergency",
                "alarm",
                "warning",
                "preset_jump",
                "preset_jump behind an alarm",
            )
        )
        # What drives no joint may stand anywhere. Behind an alarm, a transducer may have come that far by itself.
        on = {"alarm": self._positions, "preset_jump": self._joints, "preset_jump behind an alarm": self._encoders}
        node = DIAGNOSED if kind == "warning" else self._rng.choice(sorted(on.get(kind, self._nodes)))
        names, lasts_s = self._nodes[node], self._rng.uniform(2.0, 14.0)
        counts = self._rng.choice((-1, 1)) * (12_000 if node in self._encoders else 4_000)
        if kind == "preset_jump behind an alarm":
            self._rig.do("fault", kind="alarm", node=node, seconds=1.0)
            self._rig.do("fault", kind="preset_jump", node=node, counts=counts, in_s=0.5)
            self._expect(kind, names, LINK, at_ns=self._rig.now_ns() + NS_PER_S)  # it is seen when the alarm is gone
            self._wait(8.0)
            self._fault("preset_jump", names, LINK, node=node, counts=-counts)
        elif kind == "preset_jump":
            self._fault(kind, names, LINK, node=node, counts=counts)
            self._wait(8.0)
            self._fault(kind, names, LINK, node=node, counts=-counts)
        elif kind == "node_silent":
            self._fault(kind, names, LINK, node=node, seconds=lasts_s)
            self._expect_alarm(kind, names, LINK, lasts_s)
            self._wait(lasts_s)
            self._expect("node speaks again", names, LINK)
        elif kind == "emergency":
            code = self._rng.choice((0x5000, 0x8130, 0x3100))
            self._fault(kind, names, LINK, node=node, code=code)
            self._expect_alarm(kind, names, LINK, lasts_s)
            self._wait(lasts_s)
            self._fault("emergency_clear", names, LINK, node=node)
        elif kind == "alarm":
            self._fault(kind, names, LINK, node=node, seconds=lasts_s)
            self._expect_alarm(kind, names, LINK, lasts_s)
            self._wait(lasts_s)
        elif kind == "warning":
            self._fault(kind, names, LINK, node=node)
            self._expect_alarm(kind, names, LINK, lasts_s)
            self._wait(lasts_s)
            self._fault(kind, names, LINK, node=node, bits=0)
        else:
            self._fault(kind, names, LINK, node=node)
        self._wait(7.0)
        if any(self._watch.channels.get(name) == "device_alarm" for name in names):
            # What took it back was not heard, the link being down. An operator switches the device off and on.
            self._rig.do("fault", kind="node_reboot", node=node)

    def _signal_fault(self) -> None:
        if self._rng.random() < 0.5:
            self._fault("counter_gap", self._signals, LINK, count=self._rng.randint(1, 14))
        else:
            lasts_s = self._rng.uniform(1.0, 15.0)
            self._fault("not_available", self._signals, LINK, seconds=lasts_s)
            self._expect_alarm("not_available", self._signals, LINK, lasts_s)
            self._wait(lasts_s)
        self._wait(6.0)

    def _bus_fault(self) -> None:
        if self._rng.random() < 0.25:
            self._unplug("can", LINK, self._rng.uniform(1.0, 16.0))
            return
        state = self._rng.choice(("warning", "passive", "bus_off", "acknowledge"))
        if state == "acknowledge":  # told at most every 10 s
            self._wait(10.0)
        lasts_s = self._rng.uniform(2.0, 14.0)
        self._fault("bus_error", (LINK,), LINK, state=state)
        if state == "passive":  # bus-off that is followed by frames is over
            self._expect_alarm("bus_error", (LINK,), LINK, lasts_s)
        self._wait(lasts_s)
        if state != "acknowledge":
            self._fault("bus_error", (LINK,), LINK, state="active")
        self._wait(3.0)

    def _daemon_fault(self) -> None:
        with self._process:
            if self._stop.is_set():
                return
            begin_ns = self._rig.now_ns()
            if self._rng.random() < 0.5:
                self._daemon.hold(self._rng.uniform(0.5, 4.0))
                self._expect("daemon held", (LINK, STATION), "")
            else:
                self._daemon.allow_writing(allowed=False)
                self._expect("store not writable", ("store",), "")
                lasts_s = self._rng.uniform(4.0, 16.0)
                self._expect_alarm("store not writable", ("store",), "", lasts_s)
                self._wait(lasts_s)
                self._daemon.allow_writing(allowed=True)
                self._expect("store writable again", ("store",), "")
                self._wait(4.0)
            self._blackout("*", begin_ns)

    def _client_fault(self) -> None:
        kind = self._rng.choice(("silent", "half", "deaf"))
        with contextlib.ExitStack() as stack:
            self.hanging = self._rng.randint(1, 10)
            for _ in range(self.hanging):
                client = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
                client.settimeout(1.0)
                with contextlib.suppress(OSError):
                    client.connect(str(self._daemon.socket))
                    asked = json.dumps({"command": "status"}).encode()
                    client.sendall({"silent": b"", "half": asked[:9], "deaf": (asked + b"\n") * 100}[kind])
            self._expect("clients that hang", ("daemon",), "")
            self._wait(self._rng.uniform(5.0, 40.0))
        self._wait(CLOSES_S)
        self.hanging = 0

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _unplug(self, what: str, link: str, lasts_s: float) -> None:
        begin_ns = self._rig.now_ns()
        self._rig.do("fault", kind="unplug", link=what, seconds=lasts_s)
        self._expect(f"unplug {what}", (link,), "", at_ns=begin_ns)
        self._expect_alarm(f"unplug {what}", (link,), "", lasts_s)
        self._wait(lasts_s + 0.1)
        self._expect(f"{what} back", (link,), "")
        self._wait(8.0)
        self._blackout(link, begin_ns)

    def _fault(self, kind: str, subjects: Sequence[str], on: str, **given: float | str) -> None:
        at_ns = self._rig.now_ns()
        self._rig.do("fault", kind=kind, **given)
        self._expect(kind, subjects, on, at_ns=at_ns)

    def _expect_alarm(self, fault: str, subjects: Sequence[str], link: str, lasts_s: float) -> None:
        """The fault that has just begun lasts so long: if that is long, there must be an alarm."""
        if self._watch.alarms and lasts_s >= LONG_S:
            expected = (Expected("alarm", ALARMS[fault]),)
            self._watch.expect(Case(f"{fault}: alarm", tuple(subjects), link, self._rig.now_ns(), expected))

    def _expect(self, name: str, subjects: Sequence[str], link: str, *, at_ns: int | None = None) -> None:
        at_ns = self._rig.now_ns() if at_ns is None else at_ns
        self._watch.expect(Case(name, tuple(subjects), link, at_ns, EVIDENCE[name]))

    def _blackout(self, link: str, begin_ns: int) -> None:
        end_ns = self._rig.now_ns() + round(AFTERWARDS_S * NS_PER_S)
        self.blackouts.append(Blackout(link, begin_ns, end_ns))

    def _wait(self, rig_s: float) -> bool:
        return self._rig.clock.wait(self._stop, rig_s)
