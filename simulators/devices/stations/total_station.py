"""A total station on a serial line: its settings, its measurements, and faults of its answers.

The protocols are in `topcon.py` and `sokkia.py`. A station does no I/O: it takes bytes and the time, and returns bytes
at the speed of the line. Times are simulated seconds.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from simulators.devices.stations.serial_line import Line
from simulators.devices.stations.topcon_text import Sight
from simulators.devices.stations.tracker import Flag, Tracker, TrackerSettings

Profile = Literal["topcon_gts8", "topcon_classic", "sokkia_set"]


@dataclass(frozen=True)
class StationSettings:
    """Settings in the instrument's menus, and its timing.

    Attributes:
        profile: protocol of the instrument.
        baud: baud rate of its serial line.
        crlf: frames end with CR LF (Topcon).
        checksum: replies end with a sum (Sokkia).
        ack_s: time from a command to the start of its acknowledgement.
        measure_s: time from the acknowledgement to the start of the record in tracking EDM mode; fine and coarse single
            measurements of classic instruments take 1.5 s and 0.7 s longer.
        latency_s: age of a measurement when its record starts.
        nak_bad_check: answer a wrong block check with NAK instead of silence.
        retransmissions: number of repetitions of a record that the host does not acknowledge within 0.3 s.
        stale_distance: while coasting, repeat the last distance instead of 0.
        prism_mm, ppm: corrections set on the instrument and applied to the displayed distance.
        prism_true_mm, ppm_true: correct values for the prism and the air.
        push_interval_s: interval at which records are sent without request (passive listening); None to send only on
            request.
        tracker: settings of the servo.
    """

    profile: Profile = "topcon_gts8"
    baud: int = 9600
    crlf: bool = True
    checksum: bool = True
    ack_s: float = 0.02
    measure_s: float = 0.03
    latency_s: float = 0.02
    nak_bad_check: bool = False
    retransmissions: int = 0
    stale_distance: bool = False
    prism_mm: float = 0.0
    ppm: float = 0.0
    prism_true_mm: float = 0.0
    ppm_true: float = 0.0
    push_interval_s: float | None = None
    tracker: TrackerSettings = field(default_factory=TrackerSettings)


@dataclass
class StationFaults:
    """Pending faults, counted down as they occur.

    Attributes:
        bad_checks: number of records to send with a wrong check.
        dropped_acks: number of commands to leave unacknowledged.
        joined: number of acknowledgements to send in one buffer with their record, without their first byte and end.
        clutter: number of random bytes to send before the next record.
        silent_until: the station neither receives nor sends before this instant.
    """

    bad_checks: int = 0
    dropped_acks: int = 0
    joined: int = 0
    clutter: int = 0
    silent_until: float = -math.inf


class TotalStation(ABC):
    """Base of all instruments: line, telescope, circles, distance meter.

    Attributes:
        settings, faults: see StationSettings and StationFaults.
        tracker: the telescope.
        circle_zero_deg: direction from north at which the horizontal circle reads 0.
        on_measured: called with target and instant for each measured distance; None for no call.
    """

    def __init__(self, settings: StationSettings, tracker: Tracker, rng: np.random.Generator) -> None:
        self.settings = settings
        self.faults = StationFaults()
        self.tracker = tracker
        self.circle_zero_deg = 0.0
        self.on_measured: Callable[[str, float], None] | None = None
        self._rng = rng
        self._line = Line(settings.baud)
        self._face = 1
        self._last_slope_m = 0.0
        self._on = True
        if settings.push_interval_s is not None:
            self._line.later(0.0, self._push)

    @property
    def robotic(self) -> bool:
        """True if the instrument has a servo and locks on prisms."""
        return self.settings.profile != "topcon_classic"

    def receive(self, data: bytes, now_s: float) -> None:
        """Process bytes written by the host."""
        if now_s < self.faults.silent_until:
            return
        for i in range(len(data)):
            self._hear(data[i : i + 1], self._line.heard_at(now_s, 1))

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that the instrument has sent by now."""
        out = self._line.poll(now_s)
        return b"" if now_s < self.faults.silent_until else out

    def next_deadline(self) -> float:
        """Return the instant at which `poll` is due."""
        return self._line.next_deadline()

    def aim_at(self, name: str, now_s: float) -> None:
        """Point at a target like an operator, and lock on it if the instrument can; ValueError if it is unknown."""
        self.tracker.aim_at(name, now_s, track=self.robotic)

    def sight(self, now_s: float) -> Sight:
        """Measure in the direction of the telescope."""
        settings = self.settings
        flag = self.tracker.flag(now_s)
        pointing = self.tracker.point(now_s)
        slope_m = 0.0
        if pointing.range_mm is not None:
            shown_mm = pointing.range_mm * (1 + (settings.ppm - settings.ppm_true) * 1e-6)
            slope_m = (shown_mm + settings.prism_mm - settings.prism_true_mm) / 1e3
            self._last_slope_m = slope_m
            if self.on_measured is not None and pointing.target is not None:
                self.on_measured(pointing.target, now_s)
        elif flag is Flag.LOCKED and settings.stale_distance:
            slope_m = self._last_slope_m
        hz, zenith = pointing.hz_deg - self.circle_zero_deg, pointing.zenith_deg
        if self._face == 2:
            hz, zenith = hz + 180.0, 360.0 - zenith
        return Sight(
            hz_deg=hz % 360,
            zenith_deg=zenith,
            slope_m=slope_m,
            edm_level=15 if pointing.range_mm is not None else 0,
            ppm=settings.ppm,
            prism_mm=settings.prism_mm,
            battery=4,
            tracking=int(flag),
            face=self._face,
        )

    def plunge(self) -> None:
        """Turn the telescope over to the other face."""
        self._face = 3 - self._face

    def set_circle(self, reading_deg: float, now_s: float) -> None:
        """Set the horizontal circle so that it reads `reading_deg` in the current direction (face 1)."""
        self.circle_zero_deg = (self.tracker.point(now_s).hz_deg - reading_deg) % 360

    @abstractmethod
    def _hear(self, byte: bytes, at_s: float) -> None:
        """Process one byte from the host at an instant."""

    @abstractmethod
    def _measurement(self, at_s: float) -> bytes:
        """Return a record to send without request."""

    def _push(self, at_s: float) -> None:
        if self._on:
            self._send_record(at_s, self._measurement(at_s))
        if self.settings.push_interval_s is not None:
            self._line.later(at_s + self.settings.push_interval_s, self._push)

    def _send_record(self, at_s: float, record: bytes) -> float:
        """Send a finished record with pending faults applied; return when it is sent."""
        faults = self.faults
        if faults.bad_checks > 0:
            faults.bad_checks -= 1
            record = self._spoilt(record)
        if faults.clutter > 0:
            record = bytes(self._rng.integers(0x20, 0x7F, faults.clutter, dtype=np.uint8)) + record
            faults.clutter = 0
        return self._line.send(at_s, record)

    @staticmethod
    def _spoilt(record: bytes) -> bytes:
        """Change one digit of a record's distance, so that its check becomes wrong."""
        place = next(i for i, byte in enumerate(record) if chr(byte).isdigit()) + 5
        return record[:place] + bytes([record[place] ^ 0x01]) + record[place + 1 :]
