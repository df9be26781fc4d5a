"""Decoder of SocketCAN error frames (linux/can/error.h): the controller's state and protocol errors, as events."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind

ERROR_REPEAT_NS = 10 * NS_PER_S
"""Minimum interval between reports of errors that do not change the controller's state; a report has their count."""

STATE_REPEAT_NS = 4 * NS_PER_S
"""Minimum interval between reports of the same state of the controller; a repeated state is reported after it."""

# Error class, in the identifier
_TX_TIMEOUT = 0x001
_LOST_ARBITRATION = 0x002
_CONTROLLER = 0x004
_PROTOCOL = 0x008
_TRANSCEIVER = 0x010
_NO_ACKNOWLEDGE = 0x020
_BUS_OFF = 0x040
_BUS_ERROR = 0x080
_RESTARTED = 0x100

# data[1], controller
_RX_OVERFLOW = 0x01
_TX_OVERFLOW = 0x02
_WARNING = 0x0C  # receiving or transmitting
_PASSIVE = 0x30
_ACTIVE = 0x40

_PROTOCOL_TYPES = {  # data[2]
    0x01: "single bit error",
    0x02: "frame format error",
    0x04: "bit stuffing error",
    0x08: "dominant bit could not be sent",
    0x10: "recessive bit could not be sent",
    0x20: "bus overload",
    0x40: "active error announcement",
    0x80: "error while transmitting",
}

_STATE_TEXTS = {
    EventKind.BUS_ERROR_ACTIVE: "the controller is error-active again: the bus works normally",
    EventKind.BUS_ERROR_WARNING: "the controller's error count reached 96: check cabling, termination and bit rate",
    EventKind.BUS_ERROR_PASSIVE: "the controller is error-passive: check cabling, termination and bit rate",
    EventKind.BUS_OFF: "the controller is bus-off and has stopped communicating: check cabling, termination and bit"
    " rate; set restart-ms on the interface to restart it automatically",
}


@dataclass
class _Kind:
    count: int = 0
    unreported: int = 0
    reported: Stamp | None = None


@dataclass
class BusErrors:
    """Decoder of the error frames of one link.

    The controller's state is reported when it changes. A state other than error-active is reported again, at most every
    STATE_REPEAT_NS, if it is announced again: meanwhile the controller may have worked, or the link may have been
    reopened, which no error frame shows. Other errors are reported the first time and then at most every
    ERROR_REPEAT_NS, with their number since the last report.

    Attributes:
        link: name of the link.
        state: last known state of the controller.
        count: number of error frames so far.
    """

    link: str
    state: EventKind = EventKind.BUS_ERROR_ACTIVE
    count: int = 0
    _told: Stamp | None = None
    _again: DeviceEvent | None = None
    _errors: _Kind = field(default_factory=_Kind)
    _overflows: _Kind = field(default_factory=_Kind)

    def feed(self, stamp: Stamp, error_class: int, data: bytes) -> list[DeviceEvent]:
        """Return the events of one error frame.

        Args:
            stamp: when the frame was received.
            error_class: error class bits from the frame's identifier.
            data: data of the frame.
        """
        self.count += 1
        data = data.ljust(8, b"\0")
        events = self.tick(stamp)
        state = _state(error_class, data[1])
        if state is not None:
            counters = f" (error counters: {data[6]} sending, {data[7]} receiving)" if data[6] or data[7] else ""
            text = f"{self.link}: {_STATE_TEXTS[state]}{counters}"
            events += self._announced(DeviceEvent(self.link, stamp, state, text))
        if error_class & _CONTROLLER and data[1] & (_RX_OVERFLOW | _TX_OVERFLOW):
            what = "received" if data[1] & _RX_OVERFLOW else "transmitted"
            text = f"the controller's buffer of {what} frames overflowed"
            self._report(self._overflows, EventKind.FRAMES_DROPPED, stamp, text, events)
        errors = _errors(error_class, data)
        if errors:
            self._report(self._errors, EventKind.BUS_ERROR, stamp, ", ".join(errors), events)
        return events

    def tick(self, now: Stamp) -> list[DeviceEvent]:
        """Return the report of a repeated state when it is due."""
        if self._again is None or self._told is None or now.since(self._told) < STATE_REPEAT_NS:
            return []
        event, self._again = self._again, None
        self._told = self._told.shifted(STATE_REPEAT_NS)
        return [event]

    def _announced(self, event: DeviceEvent) -> list[DeviceEvent]:
        """Return the event of a state that the controller announces, unless it was reported a short time ago."""
        is_repeated, self.state, self._again = event.kind is self.state, event.kind, None
        if is_repeated and event.kind is EventKind.BUS_ERROR_ACTIVE:
            return []
        if is_repeated and self._told is not None and event.stamp.since(self._told) < STATE_REPEAT_NS:
            self._again = event
            return []
        self._told = event.stamp
        return [event]

    def _report(self, kind: _Kind, event: EventKind, stamp: Stamp, text: str, events: list[DeviceEvent]) -> None:
        kind.count += 1
        kind.unreported += 1
        if kind.reported is not None and stamp.since(kind.reported) < ERROR_REPEAT_NS:
            return
        times = "" if kind.unreported == 1 else f"; {kind.unreported} times since the last report"
        events.append(DeviceEvent(self.link, stamp, event, f"{self.link}: {text}{times}", kind.count))
        kind.unreported = 0
        kind.reported = stamp


def _state(error_class: int, controller: int) -> EventKind | None:
    """Return the state that an error frame announces, or None."""
    if error_class & _BUS_OFF:
        return EventKind.BUS_OFF
    if error_class & _CONTROLLER:
        for bits, state in (
            (_PASSIVE, EventKind.BUS_ERROR_PASSIVE),
            (_WARNING, EventKind.BUS_ERROR_WARNING),
            (_ACTIVE, EventKind.BUS_ERROR_ACTIVE),
        ):
            if controller & bits:
                return state
    if error_class & _RESTARTED:
        return EventKind.BUS_ERROR_ACTIVE
    return None


def _errors(error_class: int, data: bytes) -> list[str]:
    """Return descriptions of the errors on the wire."""
    words = []
    if error_class & _TX_TIMEOUT:
        words.append("transmission timed out")
    if error_class & _LOST_ARBITRATION:
        words.append(f"arbitration lost in bit {data[0]}" if data[0] else "arbitration lost")
    if error_class & _PROTOCOL:
        words += [text for bit, text in _PROTOCOL_TYPES.items() if data[2] & bit] or ["protocol violation"]
    if error_class & _TRANSCEIVER:
        words.append(f"transceiver status {data[4]:02X}h: check the wiring of CAN-H and CAN-L")
    if error_class & _NO_ACKNOWLEDGE:
        words.append("no node acknowledged a frame: check that other nodes are powered and use the same bit rate")
    if error_class & _BUS_ERROR and not words:
        words.append("bus error")
    return words
