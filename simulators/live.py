"""A simulated rig on ptys, in real or scaled time: one thread, one loop."""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from drivers.clock import NS_PER_S, Clock
from simulators.control import Control
from simulators.devices.can.slcan_adapter import Channel, SlcanAdapter
from simulators.pty_port import PtyPort
from simulators.rig_simulator import Output, RigSimulator
from simulators.wire_log import WireLog

_SHORTEST_SLEEP_S = 0.001  # real: finer would only cost
_LONGEST_SLEEP_S = 0.5
_LONGEST_LINE = 65536


class LiveRig:
    """A simulated rig's two links, and its commands as JSON lines.

    Attributes:
        begin: the clock at simulated second 0.

    Args:
        simulator: the rig.
        clock: shared with the host.
        can_port, station_port: where the ports appear.
        send: takes each answer and event.
        log: takes the traffic on the links; None: no log.

    Raises:
        OSError: a port cannot be made.
    """

    def __init__(
        self,
        simulator: RigSimulator,
        clock: Clock,
        can_port: Path,
        station_port: Path,
        send: Callable[[Mapping[str, object]], None],
        log: WireLog | None = None,
    ) -> None:
        self._simulator, self._clock, self._send = simulator, clock, send
        self.begin = clock.now()
        self._adapter = SlcanAdapter()
        self._can = PtyPort(can_port)
        try:
            self._station = PtyPort(station_port)
        except OSError:
            self._can.unplug()
            raise
        self._replug: dict[PtyPort, float] = {}
        self._control = Control(simulator)
        self._lines = bytearray()
        self._log = log
        if log is not None:
            simulator.station.on_measured = self._log_measured

    def close(self) -> None:
        """Take both ports away."""
        self._can.unplug()
        self._station.unplug()

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
        """Run until the commands end (`quit`, end of file) or a byte arrives at `wake`.

        Args:
            commands: file descriptor of the JSON lines.
            wake: file descriptor that a signal handler writes to.
        """
        self._send({"event": "ready", "can_port": str(self._can.path), "station_port": str(self._station.path)})
        while not self._control.finished:
            ports = [p.fileno() for p in (self._can, self._station) if p.plugged]
            ready, _, _ = select.select([commands, wake, *ports], [], [], self._sleep_s())
            if wake in ready:
                return
            now_s = self._now_s()
            if commands in ready and not self._read_commands(commands, now_s):
                return
            self._hear(now_s)
            self._speak(self._simulator.poll(now_s), now_s)

    def _sleep_s(self) -> float:
        due_s = min([self._simulator.next_deadline(), *self._replug.values()])
        wait_s = min(due_s - self._now_s(), 60.0)
        return max(_SHORTEST_SLEEP_S, min(_LONGEST_SLEEP_S, self._clock.real_seconds(wait_s)))

    def _read_commands(self, commands: int, now_s: float) -> bool:
        """False at the end of the commands."""
        data = os.read(commands, 65536)
        self._lines += data
        *lines, rest = self._lines.split(b"\n")
        self._lines = bytearray(rest[-_LONGEST_LINE:])
        for line in lines:
            if line.strip():
                self._send(self._control.obey(bytes(line), now_s))
        return bool(data)

    def _hear(self, now_s: float) -> None:
        data = self._can.read()
        if data:
            was = self._adapter.channel
            answers, frames = self._adapter.feed(data)
            if was is Channel.CLOSED and self._adapter.channel is not Channel.CLOSED:
                self._can.discard()  # what an earlier host left unread
            self._can.write(answers)
            for frame in frames:
                self._simulator.receive_can(frame, now_s)
        self._simulator.receive_station(self._station.read(), now_s)

    def _speak(self, output: Output, now_s: float) -> None:
        if self._log is not None:
            at_ns = self._monotonic_ns(now_s)
            self._log.frames(at_ns, output.frames)
            self._log.station(at_ns, output.station)
        self._can.write(b"".join(self._adapter.encode(frame) for frame in output.frames))
        self._station.write(output.station)
        for event in output.events:
            if event.get("kind") == "unplug":
                port = self._can if event["link"] == "can" else self._station
                port.unplug()
                self._replug[port] = now_s + float(str(event["seconds"]))
            self._tell(event, now_s)
        for port, at_s in list(self._replug.items()):
            if now_s >= at_s:
                del self._replug[port]
                if port is self._can:
                    self._adapter = SlcanAdapter()
                port.plug()
                self._tell({"event": "plugged", "link": "can" if port is self._can else "station"}, now_s)

    def _tell(self, event: Mapping[str, object], now_s: float) -> None:
        if self._log is not None:
            self._log.event(self._monotonic_ns(now_s), event)
        self._send(event)


def print_line(message: Mapping[str, object]) -> None:
    """Write a JSON line to standard output."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()
