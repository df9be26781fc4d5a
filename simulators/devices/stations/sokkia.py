"""Sokkia SET stations: one-byte requests, settings that end with CR, replies of three fields."""

from __future__ import annotations

import re

import numpy as np

from simulators.devices.stations.topcon_text import ACK, NAK, set_line, set_record
from simulators.devices.stations.total_station import StationSettings, TotalStation
from simulators.devices.stations.tracker import Tracker

_IDENTITY = b"A SET-SIM,123456,4100,2506,"
_SETTINGS = b"B 0,0,1,0,0,0,0,0,0,1,0,0,"
_FINE_S, _RAPID_S, _TRACKING_S = 1.5, 0.6, 0.12
_LONGEST_COMMAND = 80
_SET_CIRCLE = re.compile(rb"/Dc (\d{1,3})\.(\d{2})(\d{2})")
_INPUT = re.compile(rb"(/D[a-z] [^,]*(?:,[^,]*)*?)(?:,([0-9A-F]{2}))?")

# EDM mode -> (duration of a measurement in seconds, repeats until stopped)
_EDM = {
    b"Xa": (_FINE_S, False),
    b"Xb": (_FINE_S, True),
    b"Xc": (_RAPID_S, False),
    b"Xd": (_RAPID_S, True),
    b"Xe": (_TRACKING_S, True),
}


class SokkiaStation(TotalStation):
    """A SET in measurement mode.

    Requests are the single characters 00h, 11h, 12h and (clones) 13h.

    Args:
        settings: profile `sokkia_set`.
        tracker: telescope of the station.
        rng: random generator for garbage on the line.
    """

    def __init__(self, settings: StationSettings, tracker: Tracker, rng: np.random.Generator) -> None:
        super().__init__(settings, tracker, rng)
        self._buffer = bytearray()
        self._mode = b"Xa"
        self._measuring = 0

    def _hear(self, byte: bytes, at_s: float) -> None:
        if byte in b"\x00\x11\x12\x13":
            self._line.later(at_s, lambda now_s: self._measure(byte, now_s))
        elif byte in b"\r\n":
            command = bytes(self._buffer)
            self._buffer.clear()
            if command:
                self._line.later(at_s, lambda now_s: self._obey(command, now_s))
        else:
            self._buffer += byte
            del self._buffer[:-_LONGEST_COMMAND]

    def _measure(self, request: bytes, at_s: float) -> None:
        self._measuring += 1  # stops the measurement in progress
        if request == b"\x12":
            return
        if request in b"\x00\x13":
            self._line.later(at_s + self.settings.ack_s, self._angles)
            return
        self._shoot(at_s, self._measuring)

    def _angles(self, at_s: float) -> None:
        self._send_record(at_s, self._measurement(at_s))

    def _shoot(self, at_s: float, number: int) -> None:
        duration_s, repeats = _EDM[self._mode]

        def finish(now_s: float) -> None:
            if number == self._measuring:
                out_s = self._send_record(now_s, self._measurement(now_s))
                if repeats:
                    self._shoot(max(now_s, out_s - duration_s), number)

        self._line.later(at_s + duration_s, finish)

    def _measurement(self, at_s: float) -> bytes:
        return set_record(self.sight(at_s - self.settings.latency_s), checksum=self.settings.checksum)

    def _obey(self, command: bytes, at_s: float) -> None:
        if command in (b"A", b"B"):
            text = _IDENTITY if command == b"A" else _SETTINGS
            line = set_line(text if self.settings.checksum else text[:-1], checksum=self.settings.checksum)
            self._line.send(at_s + self.settings.ack_s, line)
            return
        done = self._set(command, at_s)
        if done and self.faults.dropped_acks > 0:
            self.faults.dropped_acks -= 1
            return
        self._line.send(at_s + self.settings.ack_s, ACK if done else NAK)

    def _set(self, command: bytes, at_s: float) -> bool:
        """Apply a setting; return True if the command is valid."""
        if command in _EDM:
            self._mode = command
            return True
        if command == b"Xh":
            self.set_circle(0.0, at_s)
            return True
        if command in (b"Xk", b"Xl"):
            return command == b"Xk"  # this instrument only supports angles to the right
        given = _INPUT.fullmatch(command)
        if given is None:
            return False
        if given[2] is not None and b"%02X" % (sum(given[1] + b",") % 256) != given[2]:
            return False
        circle = _SET_CIRCLE.fullmatch(given[1])
        if circle is not None:
            degree, minute, second = (int(part) for part in circle.groups())
            self.set_circle(degree + minute / 60 + second / 3600, at_s)
        return circle is not None
