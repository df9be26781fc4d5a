"""Topcon stations: the GTS handshake with the classic commands and the commands of the robotic GTS-8 family."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from simulators.devices.stations.topcon_text import (
    ACK,
    ETX,
    NAK,
    Sight,
    angle_record,
    checked,
    coarse_record,
    coordinate_record,
    fine_record,
    frame,
    from_dms,
    tracking_angles,
    tracking_record,
)
from simulators.devices.stations.total_station import StationSettings, TotalStation
from simulators.devices.stations.tracker import Tracker

_HOST_ACK_S = 0.3
_RETRY_S = 0.5  # pause before a retry if no prism was found
_LONGEST_COMMAND = 40
_TURN = re.compile(r"(T1[013])([+-]\d{7})([+-]\d{7})d")
_SET_CIRCLE = re.compile(r"(?:J|ZB1)\+(\d{5,7})d")
_SETTING = re.compile(r"Z[BCD][0-9+-].*|Z\d\d")

# mode command -> (record, seconds that a measurement takes longer than in tracking mode)
_MODES: dict[str, tuple[Callable[[Sight], bytes], float]] = {
    "Z12": (angle_record, 0.0),
    "Z20": (angle_record, 0.0),
    "Z32": (coarse_record, 0.7),
    "Z34": (fine_record, 1.5),
    "Z64": (coordinate_record, 1.5),
}


class TopconStation(TotalStation):
    """A station that acknowledges, measures, and answers with a record.

    Args:
        settings: profile `topcon_gts8` or `topcon_classic`.
        tracker: telescope of the station.
        rng: random generator for garbage on the line.
    """

    def __init__(self, settings: StationSettings, tracker: Tracker, rng: np.random.Generator) -> None:
        super().__init__(settings, tracker, rng)
        self._buffer = bytearray()
        self._mode = "Z34"
        self._measuring = 0  # number of the measurement in progress; a change stops it
        self._awaiting_ack = 0
        self._pending_ack = b""  # held back to arrive together with its record

    def _hear(self, byte: bytes, at_s: float) -> None:
        if byte in b"\r\n":
            return
        if byte != ETX:
            self._buffer += byte
            del self._buffer[:-_LONGEST_COMMAND]
            return
        block = bytes(self._buffer)
        self._buffer.clear()
        self._line.later(at_s, lambda now_s: self._obey(block, now_s))

    def _obey(self, block: bytes, at_s: float) -> None:
        data = checked(block)
        if data is None:
            if self.settings.nak_bad_check:
                self._line.send(at_s + self.settings.ack_s, frame(NAK, crlf=self.settings.crlf))
            return
        if data.startswith(ACK):
            self._awaiting_ack = 0
            return
        command = data.decode("latin-1")
        if not self._on and command != "G8SW1":
            return
        if self.settings.profile == "topcon_gts8" and self._obey_robotic(command, at_s):
            return
        self._obey_classic(command, at_s)

    def _obey_classic(self, command: str, at_s: float) -> None:
        setting = _SET_CIRCLE.fullmatch(command)
        if command == "C":
            make, more_s = _MODES[self._mode]
            self._measure(at_s, make, more_s, needs_distance=self._mode not in ("Z12", "Z20"))
        elif command in _MODES:
            self._measuring += 1  # a mode command stops a measurement
            self._mode = command
            self._acknowledge(at_s)
        elif setting:
            self.set_circle(from_dms(setting[1].rjust(7, "0")), at_s)
            self._acknowledge(at_s)
        elif command == "J":
            self._acknowledge(at_s)

    def _obey_robotic(self, command: str, at_s: float) -> bool:
        """Carry out a command of the robotic family; return False if it is not one."""
        turn = _TURN.fullmatch(command)
        if command == "C11":
            self._measure(at_s, tracking_record, 0.0, needs_distance=False)
        elif command == "C31":
            self._measure(at_s, tracking_angles, 0.0, needs_distance=False)
        elif command in ("T34", "T30", "T200"):
            act = {"T34": self.tracker.track, "T30": self.tracker.stand_by}.get(command)
            if act is None:
                self.plunge()
            else:
                act(at_s)
            self._acknowledge(at_s)
        elif turn:
            self._turn(turn, at_s)
            self._acknowledge(at_s)
        elif command in ("G8SW1", "G8SW0"):
            self._on = command == "G8SW1"
            self._acknowledge(at_s)
        elif _SETTING.fullmatch(command) and command not in _MODES and not _SET_CIRCLE.fullmatch(command):
            self._acknowledge(at_s)
        else:
            return False
        return True

    def _turn(self, command: re.Match[str], at_s: float) -> None:
        # Both arguments are relative: vertical = now - target, horizontal = target - now
        now = self.tracker.point(at_s)
        hz, zenith = now.hz_deg + from_dms(command[3]), now.zenith_deg - from_dms(command[2])
        self.tracker.turn(hz, max(0.0, min(180.0, zenith)), at_s, search=command[1] == "T13")

    def _acknowledge(self, at_s: float) -> float:
        """Send ACK unless it gets lost; return when it is sent."""
        start = at_s + self.settings.ack_s
        if self.faults.dropped_acks > 0:
            self.faults.dropped_acks -= 1
            return start
        return self._line.send(start, frame(ACK, crlf=self.settings.crlf))

    def _measure(self, at_s: float, make: Callable[[Sight], bytes], more_s: float, *, needs_distance: bool) -> None:
        self._measuring += 1
        number = self._measuring
        if self.faults.joined > 0:
            self.faults.joined -= 1
            self._pending_ack, out_s = b"006", at_s + self.settings.ack_s
        else:
            self._pending_ack, out_s = b"", self._acknowledge(at_s)

        def finish(now_s: float) -> None:
            if number != self._measuring:
                return
            sight = self.sight(now_s - self.settings.latency_s)
            if needs_distance and sight.slope_m == 0.0:
                self._line.later(now_s + _RETRY_S, finish)
                return
            self._report(now_s, frame(make(sight), crlf=self.settings.crlf))

        self._line.later(out_s + self.settings.measure_s + more_s, finish)

    def _report(self, at_s: float, record: bytes) -> None:
        if self._pending_ack:
            record, self._pending_ack = self._pending_ack + record, b""
            self._line.send(at_s, record, at_once=True)
            return
        self._repeat(self._send_record(at_s, record), record, self.settings.retransmissions)

    def _repeat(self, out_s: float, record: bytes, left: int) -> None:
        self._awaiting_ack += 1
        if left:

            def again(now_s: float) -> None:
                if self._awaiting_ack:
                    self._repeat(self._send_record(now_s, record), record, left - 1)

            self._line.later(out_s + _HOST_ACK_S, again)

    def _measurement(self, at_s: float) -> bytes:
        make = tracking_record if self.settings.profile == "topcon_gts8" else _MODES[self._mode][0]
        return frame(make(self.sight(at_s - self.settings.latency_s)), crlf=self.settings.crlf)
