"""The loop that owns a total station's serial port, polls the station and captures all bytes in both directions."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing

from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.device_watch import watch_path
from drivers.errors import LinkError
from drivers.last_reads import LAST_READ_S, LastReads, more_may_wait
from drivers.outage import BACKOFF_MAX_S, Backoff, Outage
from drivers.readings import DeviceEvent, LinkItem, SerialCapture
from drivers.stall_detector import NOT_READ_IN_TIME, LateReport, StallDetector
from drivers.stations.config import StationConfig
from drivers.stations.poller import Poller
from drivers.stations.serial_port import SerialPort

_LONGEST_READ_S = 0.5  # longest delay until an idle loop notices a stop
_LONGEST_WRITE_S = 5.0

Emit = Callable[[LinkItem], None]


class StationLink:
    """Owns a station's port: reopens it after a loss, polls the station and passes on all bytes as captures.

    Records are decoded elsewhere from the captures. Here replies only determine what the poller sends next.

    Args:
        config: configuration of the station.
        clock: timestamps captures and times the polling.
    """

    def __init__(self, config: StationConfig, clock: Clock) -> None:
        self.name = config.name
        self.read_until: Stamp | None = None
        self._config = config
        self._clock = clock
        self._last_read = clock.now()

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Poll and listen until `stop` is set.

        Emits captures at once; LINK_UP, LINK_LOST, CONFIGURED and INSTRUMENT_ERROR events; and the LINK_DOWN gap.
        """
        backoff, outage = Backoff(), Outage(self.name, emit)
        with closing(watch_path(self._config.serial.path)) as watch:
            while not stop.is_set():
                opened: Stamp | None = None
                try:
                    began = self._clock.now()
                    port = SerialPort(self._config.serial, self.name, self._clock.real_seconds(_LONGEST_WRITE_S))
                    with closing(port):
                        watch.close()
                        opened = self._last_read = self.read_until = self._clock.now()
                        outage.end(opened, f"{self._config.serial.path} opened")
                        self._serve(port, emit, stop, began)
                except LinkError as error:
                    now = self._clock.now()
                    # Everything since the last read is lost with the device, however long ago that read was
                    outage.begin(str(error), now, now if opened is None else self._last_read)
                    self.read_until = None
                    is_short_lived = opened is not None and now.since(opened) < BACKOFF_MAX_S * NS_PER_S
                    if opened is not None and not is_short_lived:
                        backoff.reset()
                    pause_s = backoff.next_s()
                    real_s = min(pause_s, self._clock.real_seconds(pause_s))
                    if is_short_lived:
                        stop.wait(real_s)  # the device comes and goes; reacting to each return would be a busy loop
                    else:
                        watch.wait(stop, real_s)

    def _serve(self, port: SerialPort, emit: Emit, stop: threading.Event, began: Stamp) -> None:
        """Talk to the station until `stop` or a LinkError; `began` is the time just before its port was opened."""
        late = LateReport(self.name, "bytes", began)
        try:
            self._listen(port, emit, stop, late, StallDetector(self._clock, began))
        finally:
            for item in late.end(self._clock.now()):
                emit(item)

    def _listen(
        self, port: SerialPort, emit: Emit, stop: threading.Event, late: LateReport, stalls: StallDetector
    ) -> None:
        poller = start_poller(self._config)
        last_reads, is_emptied = LastReads(stop), False
        while not last_reads.are_over(is_emptied=is_emptied):
            wait_s = _LONGEST_READ_S
            if poller is not None and not last_reads.have_begun():
                try:
                    wait_s = self._send_due(port, poller, emit)
                except LinkError as error:  # what the port has received is still read
                    last_reads.begin(error)
            timeout_s = LAST_READ_S if last_reads.have_begun() else self._clock.real_seconds(wait_s)
            began = self._clock.now()
            data = port.read(timeout_s)
            self._last_read = stamp = self._clock.now()
            if is_late := stalls.is_late(stamp, timeout_s):
                stamp = stamp.doubted()
                reports = late.add(stamp, len(data), NOT_READ_IN_TIME)
            else:
                reports = late.in_time(stamp)
            for report in reports:
                emit(report)
            if data:
                capture = SerialCapture(self.name, stamp, data)
                emit(capture)
                if poller is not None:
                    poller.feed(capture)
            is_emptied = not more_may_wait(data)
            if is_emptied and not is_late:
                self.read_until = began
        if poller is not None:
            for command in poller.closing():
                self._send(port, command, emit)

    def _send_due(self, port: SerialPort, poller: Poller, emit: Emit) -> float:
        """Send all commands that are due; return the seconds until the next one."""
        now_ns = self._clock.monotonic_ns()
        while (command := poller.step(now_ns)) is not None:
            self._send(port, command, emit)
        for kind, text in poller.take_notices():
            emit(DeviceEvent(self.name, self._clock.now(), kind, text))
        now_ns = self._clock.monotonic_ns()
        return min(_LONGEST_READ_S, max(0, poller.wake_ns(now_ns) - now_ns) / NS_PER_S)

    def _send(self, port: SerialPort, command: bytes, emit: Emit) -> None:
        stamp = self._clock.now()
        port.write(command)
        emit(SerialCapture(self.name, stamp, command, is_transmitted=True))


def start_poller(config: StationConfig) -> Poller | None:
    """Return a new poller of the station; None if its profile sends nothing."""
    profile, codec = config.station_profile, config.codec
    if profile.plan is None:
        return None
    return Poller(
        profile.plan(config), lambda command: codec.encode(command, config.crlf), config.reply_reader(), config
    )
