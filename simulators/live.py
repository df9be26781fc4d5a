"""A simulated rig on its links, in real or scaled time: one thread, one loop."""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Callable, Mapping

from drivers.clock import NS_PER_S, Clock
from drivers.errors import LinkError
from simulators.control import Control
from simulators.drive import PlanDriver
from simulators.link_ends import CanEnd, LinkEnd, StationEnd
from simulators.rig_simulator import Output, RigSimulator
from simulators.wire_log import WireLog

_SHORTEST_SLEEP_S = 0.001  # real seconds; shorter sleeps would only cost CPU time
_LONGEST_SLEEP_S = 0.5
_LONGEST_LINE = 65536
_REOPEN_S = 1.0  # pause before reopening a lost interface or device


class LiveRig:
    """A simulated rig's two links, and its commands as JSON lines.

    Attributes:
        begin: time of the clock at simulated second 0.

    Args:
        simulator: the rig.
        clock: clock shared with the host.
        can, station: the rig's ends of the links.
        send: called with each answer and event.
        log: log of the traffic on the links; None for no log.
        driver: drives the boom through a plan, whose end stops the rig; None if only commands move the boom.
    """

    def __init__(
        self,
        simulator: RigSimulator,
        clock: Clock,
        can: CanEnd,
        station: StationEnd,
        send: Callable[[Mapping[str, object]], None],
        log: WireLog | None = None,
        driver: PlanDriver | None = None,
    ) -> None:
        self._simulator, self._clock, self._send = simulator, clock, send
        self._can, self._station, self._driver = can, station, driver
        self.begin = clock.now()
        self._replug: dict[str, float] = {}  # link -> when to plug it in again, simulated seconds
        self._control = Control(simulator)
        self._lines = bytearray()
        self._log = log
        if log is not None:
            simulator.station.on_measured = self._log_measured

    def _now_s(self) -> float:
        return (self._clock.monotonic_ns() - self.begin.monotonic_ns) / NS_PER_S

    def _monotonic_ns(self, at_s: float) -> int:
        return self.begin.monotonic_ns + round(at_s * NS_PER_S)

    def _log_measured(self, target: str, at_s: float) -> None:
        assert self._log is not None
        machine = self._simulator.machine
        place = self._simulator.in_instrument_frame_mm(machine.place_mm(target, at_s))
        self._log.measured(self._monotonic_ns(at_s), target, place, machine.motion.values(at_s))

    def run(self, commands: int, wake: int) -> None:
        """Run until `quit`, the end of the driver's plan or a byte at `wake`; without a driver until the commands end.

        Args:
            commands: file descriptor of the JSON lines.
            wake: file descriptor to which a signal handler writes.
        """
        if self._driver is not None:
            self._driver.start(self._now_s())
        self._send({"event": "ready", "can_port": self._can.name, "station_port": self._station.name})
        sources = [commands, wake]
        while not self._control.finished:
            ports = [end.fileno() for end in self._ends().values() if end.plugged]
            ready, _, _ = select.select([*sources, *ports], [], [], self._sleep_s())
            if wake in ready:
                return
            now_s = self._now_s()
            if commands in ready and not self._read_commands(commands, now_s):
                if self._driver is None:
                    return
                sources.remove(commands)
            self._hear(now_s)
            self._speak(self._simulator.poll(now_s), now_s)
            self._plug_again(now_s)
            if self._driver is not None and self._driver.is_over(now_s):
                self._send({"event": "driven"})
                return

    def _ends(self) -> dict[str, LinkEnd]:
        return {"can": self._can, "station": self._station}

    def _sleep_s(self) -> float:
        driven_s = [] if self._driver is None else [self._driver.next_deadline()]
        due_s = min([self._simulator.next_deadline(), *self._replug.values(), *driven_s])
        wait_s = min(due_s - self._now_s(), 60.0)
        return max(_SHORTEST_SLEEP_S, min(_LONGEST_SLEEP_S, self._clock.real_seconds(wait_s)))

    def _read_commands(self, commands: int, now_s: float) -> bool:
        """Read and carry out commands; return False at their end."""
        data = os.read(commands, 65536)
        self._lines += data
        *lines, rest = self._lines.split(b"\n")
        self._lines = bytearray(rest[-_LONGEST_LINE:])
        for line in lines:
            if line.strip():
                self._send(self._control.obey(bytes(line), now_s))
        return bool(data)

    def _hear(self, now_s: float) -> None:
        try:
            for frame in self._can.receive():
                self._simulator.receive_can(frame, now_s)
        except LinkError as error:
            self._lose("can", str(error), now_s)
        try:
            self._simulator.receive_station(self._station.read(), now_s)
        except LinkError as error:
            self._lose("station", str(error), now_s)

    def _speak(self, output: Output, now_s: float) -> None:
        if self._log is not None:
            at_ns = self._monotonic_ns(now_s)
            self._log.frames(at_ns, output.frames)
            self._log.station(at_ns, output.station)
        try:
            self._can.send(output.frames)
        except LinkError as error:
            self._lose("can", str(error), now_s)
        try:
            self._station.write(output.station)
        except LinkError as error:
            self._lose("station", str(error), now_s)
        for event in output.events:
            if event.get("kind") == "unplug":
                link = "can" if event["link"] == "can" else "station"
                self._ends()[link].unplug()
                self._replug[link] = now_s + float(str(event["seconds"]))
            self._tell(event, now_s)

    def _lose(self, link: str, text: str, now_s: float) -> None:
        """Handle the loss of a real interface or device; it is opened again when it is back."""
        self._ends()[link].unplug()
        self._replug[link] = now_s + _REOPEN_S
        self._tell({"event": "unplugged", "link": link, "text": text}, now_s)

    def _plug_again(self, now_s: float) -> None:
        for link, at_s in list(self._replug.items()):
            if now_s < at_s:
                continue
            try:
                self._ends()[link].plug()
            except LinkError:
                self._replug[link] = now_s + _REOPEN_S
                continue
            del self._replug[link]
            self._tell({"event": "plugged", "link": link}, now_s)

    def _tell(self, event: Mapping[str, object], now_s: float) -> None:
        if self._log is not None:
            self._log.event(self._monotonic_ns(now_s), event)
        self._send(event)


def print_line(message: Mapping[str, object]) -> None:
    """Write a message as a JSON line to standard output."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()
