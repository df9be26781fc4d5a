"""Set-up of CANopen nodes, on request: identify, check, configure, start. A state machine without I/O.

Nothing is written to a node until everything that it reports about itself matches the rig file. A node that does not
match is left unchanged. A node that refuses a setting stays pre-operational. The set-up of the other nodes continues.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Literal

from drivers.can.frame import Frame
from drivers.canopen.cia301 import NmtCommand, NmtState, encode_nmt, heartbeat_id, sdo_request_id, sdo_response_id
from drivers.canopen.cia404 import UNIT_TEXTS
from drivers.canopen.cia406 import ALARMS, WARNINGS
from drivers.canopen.findings import Findings, MismatchError
from drivers.canopen.pdo import (
    COB_ID_DISABLED,
    COB_ID_EXTENDED,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    TransmitPdo,
)
from drivers.canopen.sdo import (
    MISSING,
    Download,
    SdoAbortError,
    SdoExchange,
    Transfer,
    Upload,
)
from drivers.clock import NS_PER_S, Stamp
from drivers.errors import DeviceError
from drivers.readings import DeviceEvent, EventKind

ATTEMPTS = 3
ANSWER_TIMEOUT_NS = 2 * NS_PER_S  # CiA 301 defines none; nodes answer within some 10 ms, except while storing settings

DEVICE_TYPE = 0x1000  # the object that every set-up reads first
NOT_USED = "its values are not used until a set-up succeeds"
"""End of the text about a node that is not the one in the rig file; `SetupWatch.recall` needs it."""

PROFILE_ENCODER = 0x0196  # CiA 406 in the low word of object 1000h
PROFILE_ANALOGUE = 0x0194  # CiA 404

_TYPE_EVERY_SYNC = 1
_TYPE_EVENT = 254
_SCALING_ON = 1 << 2  # object 6500h


@dataclass(frozen=True, kw_only=True)
class NodeSetup:
    """Expected identity and wanted settings of a node. A value of None is not checked.

    Attributes:
        node: CANopen node number.
        name: channel name, for events.
        profile: PROFILE_ENCODER or PROFILE_ANALOGUE.
        pdo: the TPDO that the channel's decoder expects.
        pdo_number: number of that TPDO, 1 to 4.
        mode: `sync` (sampled at every SYNC) or `event_timer` (sent every `period_ms`).
        period_ms: period of the event timer.
        heartbeat_ms: heartbeat producer time; 0 leaves the node's setting unchanged.
        units_per_revolution, total_units: expected values of a rotary encoder.
        step_nm: expected measuring step of a linear transducer.
        decimal_digits: expected object 6132h of an analogue input with integer values.
    """

    node: int
    name: str
    profile: int
    pdo: TransmitPdo
    pdo_number: int = 1
    mode: Literal["sync", "event_timer"]
    period_ms: int
    heartbeat_ms: int
    units_per_revolution: int | None = None
    total_units: int | None = None
    step_nm: int | None = None
    decimal_digits: int | None = None

    @property
    def where(self) -> str:
        """Name of the node, for messages."""
        return f"{self.name} (node {self.node})"


_Step = Transfer | NmtCommand
Script = Generator[_Step, bytes, str]


class SetupRunner:
    """Sets up nodes one after the other.

    The caller feeds the nodes' answers and the time, and sends the frames returned by `take_frames`. The events
    returned by `take_events`, which is called once these frames are sent, are CONFIGURED, or ALARM for a node that does
    not match or does not answer, and WARNING for all values that could not be verified.
    """

    def __init__(self) -> None:
        self._waiting: deque[NodeSetup] = deque()
        self._setup: NodeSetup | None = None  # the one in progress
        self._script: Script
        self._exchange: SdoExchange
        self._found = Findings()
        self._attempt = 0
        self._deadline_ns = 0
        self._frames: list[Frame] = []
        self._events: list[DeviceEvent] = []

    @property
    def is_active(self) -> bool:
        """True while any set-up is in progress or waiting."""
        return self._setup is not None or bool(self._waiting)

    @property
    def deadline_ns(self) -> int | None:
        """Monotonic instant at which `advance` is due."""
        return None if self._setup is None else self._deadline_ns

    def add(self, setup: NodeSetup) -> None:
        """Add a node to the end of the queue."""
        self._waiting.append(setup)

    def feed(self, frame: Frame, now: Stamp) -> None:
        """Process a received frame."""
        if frame.is_plain and frame.data == bytes((NmtState.BOOT_UP,)):
            self._take_boot_up(frame.arbitration_id, now)
        if self._setup is None or not frame.is_plain or frame.arbitration_id != sdo_response_id(self._setup.node):
            return
        exchange = self._exchange
        try:
            self._found.check_identity(self._setup.where, frame.data)
            if exchange.feed(frame.data):
                self._attempt = 0
                self._request(self._setup, now)
        except DeviceError as error:
            self._step(self._setup, error, now)
            return
        if exchange.result is not None:
            self._step(self._setup, exchange.result, now)

    def advance(self, now: Stamp) -> None:
        """Start the next node, or repeat a request that was not answered in time."""
        if self._setup is None:
            if self._waiting:
                self._setup = self._waiting.popleft()
                self._found = Findings()
                self._script = setup_script(self._setup, self._found)
                self._step(self._setup, None, now)
        elif now.monotonic_ns >= self._deadline_ns:
            if self._attempt < ATTEMPTS:
                self._request(self._setup, now)
            else:
                seconds = ATTEMPTS * ANSWER_TIMEOUT_NS / NS_PER_S
                transfer = self._exchange.transfer
                text = f"{transfer}: no answer within {seconds:g} s; check power, node number and bit rate"
                self._step(self._setup, DeviceError(self._setup.where, text), now)

    def abort(self, now: Stamp, cause: str) -> None:
        """Cancel all set-ups because of `cause`, with an ALARM for each: they are never resumed automatically.

        A node whose CONFIGURED event was not taken yet counts as cancelled: its start command may not have been sent.
        """
        self._withdraw(cause)
        given_up = [(setup, "was not started") for setup in self._waiting]
        if self._setup is not None:
            given_up.insert(0, (self._setup, "was interrupted and may be incomplete"))
        for setup, how_far in given_up:
            text = f"node {setup.node}: set-up {how_far} because {cause}; request it again"
            self._events.append(DeviceEvent(setup.name, now, EventKind.ALARM, text))
        self._waiting.clear()
        self._setup = None
        self._frames.clear()

    def take_frames(self) -> list[Frame]:
        """Return the frames to send now."""
        frames, self._frames = self._frames, []
        return frames

    def take_events(self) -> list[DeviceEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def _request(self, setup: NodeSetup, now: Stamp) -> None:
        self._attempt += 1
        self._deadline_ns = now.monotonic_ns + ANSWER_TIMEOUT_NS
        self._frames.append(Frame(sdo_request_id(setup.node), self._exchange.request))

    def _take_boot_up(self, arbitration_id: int, now: Stamp) -> None:
        """Fail the set-up of a node that boots, which discards its settings, unless nothing was read from it yet."""
        for frame in self._frames:
            if frame == encode_nmt(NmtCommand.START, arbitration_id - heartbeat_id(0)):
                self._frames.remove(frame)
                self._withdraw("the node has booted")
                return
        setup = self._setup
        if setup is None or arbitration_id != heartbeat_id(setup.node) or self._exchange.transfer.index == DEVICE_TYPE:
            return
        text = "set-up was interrupted because the node has booted, which discards its settings; request it again"
        self._step(setup, DeviceError(setup.where, text), now)

    def _withdraw(self, cause: str) -> None:
        """Report a node whose start command was not sent as one whose set-up was interrupted because of `cause`."""
        for number, event in enumerate(self._events):
            if event.kind is EventKind.CONFIGURED:
                where, _, _ = event.text.partition(": ")
                text = f"{where}: set-up was interrupted and may be incomplete because {cause}; request it again"
                self._events[number] = replace(event, kind=EventKind.ALARM, text=text)

    def _step(self, setup: NodeSetup, outcome: bytes | DeviceError | None, now: Stamp) -> None:
        """Run the script until its next transfer or its end."""
        try:
            transfer = next_transfer(
                self._script, outcome, lambda command: self._frames.append(encode_nmt(command, setup.node))
            )
        except StopIteration as stop:
            self._end(setup, EventKind.CONFIGURED, str(stop.value), now)
        except DeviceError as error:
            text = f"{error}; the node was not started"
            if isinstance(error, MismatchError):
                text += f"; {NOT_USED}"
            self._end(setup, EventKind.ALARM, text, now)
        else:
            self._exchange = SdoExchange(setup.where, transfer)
            self._attempt = 0
            self._request(setup, now)

    def _end(self, setup: NodeSetup, kind: EventKind, text: str, now: Stamp) -> None:
        """Report the end of a node's set-up, and start the next node."""
        if warnings := self._found.warnings:  # in one event, as `status` shows the last one of a device
            self._events.append(
                DeviceEvent(setup.name, now, EventKind.WARNING, f"{setup.where}: {'; '.join(warnings)}")
            )
        self._events.append(DeviceEvent(setup.name, now, kind, text))
        self._setup = None
        self.advance(now)


def next_transfer(
    script: Script, outcome: bytes | DeviceError | None, command: Callable[[NmtCommand], object]
) -> Transfer:
    """Resume a script with the outcome of its last transfer, and return its next transfer.

    Args:
        script: made by `setup_script`.
        outcome: the data read or b"", or why the transfer has failed; None to begin.
        command: called with each NMT command that is due before the next transfer.

    Raises:
        StopIteration: the script has ended; its value is the result.
        DeviceError: the set-up has failed.
    """
    if isinstance(outcome, DeviceError):
        step = script.throw(outcome)
    else:
        step = next(script) if outcome is None else script.send(outcome)
    while isinstance(step, NmtCommand):
        command(step)
        step = script.send(b"")
    return step


def setup_script(setup: NodeSetup, found: Findings) -> Script:
    """Set up a node: yield transfers and NMT commands, receive the data read, and return a text with the result."""
    warnings = found.warnings
    identity = yield from _identify(setup, found)
    if setup.profile == PROFILE_ENCODER:
        measuring = yield from _check_position(setup, warnings)
    else:
        measuring = yield from _check_analogue(setup, warnings)
    cob_id = yield from _check_pdo(setup, warnings)
    yield NmtCommand.ENTER_PRE_OPERATIONAL
    yield from _configure(setup, cob_id)
    yield NmtCommand.START
    sampling = "at every SYNC" if setup.mode == "sync" else f"every {setup.period_ms} ms"
    return f"{setup.where}: configured and started, sends {sampling}; {identity}; {measuring}"


def _identify(setup: NodeSetup, found: Findings) -> Script:
    device_type = found.identity[DEVICE_TYPE, 0] = _unsigned((yield Upload(DEVICE_TYPE, 0)))
    if device_type & 0xFFFF != setup.profile:
        raise MismatchError(
            setup.where,
            f"expected a device of profile {setup.profile:04X}h, found device type {device_type:08X}h (object 1000h)",
        )
    parts = [f"device type {device_type:08X}h"]
    for subindex, text in ((1, "vendor"), (2, "product"), (3, "revision"), (4, "serial number")):
        number = found.identity[0x1018, subindex] = yield from _optional(0x1018, subindex)
        if number is not None:
            parts.append(f"{text} {number:X}h")
    found.serial_number = number or None  # that of the last sub-index
    return ", ".join(parts)


def _check_position(setup: NodeSetup, warnings: list[str]) -> Script:
    units = yield from _optional(0x6001, 0)
    total = yield from _optional(0x6002, 0)
    status = yield from _optional(0x6500, 0)
    resolution = yield from _optional(0x6501, 0)
    revolutions = yield from _optional(0x6502, 0)
    for index in (ALARMS, WARNINGS):
        yield from _optional(index, 0)  # for the decoder, which receives the answer from the bus
    if setup.step_nm is not None:
        step = yield from _optional(0x6005, 1)
        step = resolution if step is None else step
        _expect(setup, "measuring step in nm (6005h.1, 6501h)", setup.step_nm, step, warnings)
        return f"measuring step {step} nm"
    if status is not None and not status & _SCALING_ON and resolution is not None:
        # Scaling is off: the device counts its physical steps and ignores 6001h and 6002h
        units = resolution
        total = None if revolutions is None else resolution * max(revolutions, 1)
        objects = ("6501h, scaling off", "6501h x 6502h, scaling off")
    else:
        objects = ("6001h", "6002h")
    _expect(setup, f"units per revolution ({objects[0]})", setup.units_per_revolution, units, warnings)
    _expect(setup, f"total units ({objects[1]})", setup.total_units, total, warnings)
    return f"{units} units per revolution, {total} in total"


def _check_analogue(setup: NodeSetup, warnings: list[str]) -> Script:
    unit = yield from _optional(0x6131, 1)
    digits = yield from _optional(0x6132, 1)
    _expect(setup, "decimal digits (6132h.1)", setup.decimal_digits, digits, warnings)
    named = "unknown" if unit is None else UNIT_TEXTS.get(unit, f"{unit:08X}h")
    return f"physical unit {named}, {digits} decimal digits"


def _expect(setup: NodeSetup, what: str, expected: int | None, found: int | None, warnings: list[str]) -> None:
    if expected is None:
        return
    if found is None:
        warnings.append(f"{what}: the node does not report it; expected {expected}, not verified")
    elif found != expected:
        raise MismatchError(
            setup.where, f"{what}: expected {expected}, found {found}; correct the rig file or the node"
        )


def _check_pdo(setup: NodeSetup, warnings: list[str]) -> Generator[_Step, bytes, int]:
    """Check the TPDO's COB-ID and mapping; return the COB-ID with its flag bits."""
    communication, mapping = TPDO_COMMUNICATION + setup.pdo_number - 1, TPDO_MAPPING + setup.pdo_number - 1
    cob_id = _unsigned((yield Upload(communication, 1)))
    extended = COB_ID_EXTENDED if setup.pdo.is_extended else 0
    if cob_id & 0x3FFFFFFF != setup.pdo.arbitration_id | extended:
        raise MismatchError(
            setup.where,
            f"TPDO{setup.pdo_number} ({communication:04X}h.1): expected COB-ID {setup.pdo.arbitration_id:X}h, "
            f"found {cob_id & 0x1FFFFFFF:X}h; correct the EDS or the node",
        )
    entries = yield from _optional(mapping, 0)
    if entries is None:
        warnings.append(f"mapping ({mapping:04X}h): the node does not report it; not verified")
        return cob_id
    found: list[int] = []
    while len(found) < min(entries, 64):
        found.append(_unsigned((yield Upload(mapping, len(found) + 1))))
    expected = list(setup.pdo.mapping.words)
    if found != expected:
        raise MismatchError(
            setup.where,
            f"TPDO{setup.pdo_number} mapping ({mapping:04X}h): expected {_words(expected)}, found {_words(found)}; "
            "correct the rig file's object or EDS, or map the node",
        )
    return cob_id


def _configure(setup: NodeSetup, cob_id: int) -> Generator[_Step, bytes, None]:
    communication = TPDO_COMMUNICATION + setup.pdo_number - 1
    # Transmission type and timer may only be changed while the PDO is disabled (CiA 301)
    yield Download(communication, 1, (cob_id | COB_ID_DISABLED).to_bytes(4, "little"))
    is_synchronous = setup.mode == "sync"
    kind = _unsigned((yield Upload(communication, 2)))
    if is_synchronous and kind != _TYPE_EVERY_SYNC:
        yield Download(communication, 2, bytes((_TYPE_EVERY_SYNC,)))
    elif not is_synchronous and kind < _TYPE_EVENT:  # 254 and 255 both are event-driven
        yield Download(communication, 2, bytes((_TYPE_EVENT,)))
    timer = (0 if is_synchronous else setup.period_ms).to_bytes(2, "little")
    try:
        yield Download(communication, 5, timer)
    except SdoAbortError:
        # CiA 406 has 6200h as an alias of TPDO1's event timer; some devices have only that
        if setup.profile != PROFILE_ENCODER or setup.pdo_number != 1:
            raise
        yield Download(0x6200, 0, timer)
    yield Download(communication, 1, (cob_id & ~COB_ID_DISABLED).to_bytes(4, "little"))
    if setup.heartbeat_ms:
        yield Download(0x1017, 0, setup.heartbeat_ms.to_bytes(2, "little"))


def _optional(index: int, subindex: int) -> Generator[_Step, bytes, int | None]:
    """Read an optional unsigned object; None if the node does not have it."""
    try:
        return _unsigned((yield Upload(index, subindex)))
    except SdoAbortError as error:
        if error.code in MISSING:
            return None
        raise


def _unsigned(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _words(words: list[int]) -> str:
    return " ".join(f"{word:08X}" for word in words) or "none"
