"""A CANopen slave without a device profile (CiA 301): NMT, boot-up, heartbeat, SDO, TPDOs, EMCY, stored parameters.

It does no I/O: it takes frames and the time, and returns frames. Times are simulated seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from functools import partial

from simulators.devices.can.bus import Frame
from simulators.devices.can.object_dictionary import Abort, AbortError, Entry, Kind, ObjectDictionary, Value
from simulators.devices.can.sdo_server import SdoServer
from simulators.devices.can.tpdo import Tpdo

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")
BOOT_S = 0.25  # from power-on or reset to the boot-up message


class NmtState(IntEnum):
    """NMT states with their values in a heartbeat."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class CanopenNode:
    """A node on a bus, without power until `power_on`.

    Attributes:
        node: node number.
        state: NMT state.
        dictionary: object dictionary.

    Args:
        node: node number, 1 to 127.
        device_type: object 1000h.
        name: object 1008h.
        identity: vendor, product, revision and serial number (1018h).
        mappings: factory mapping words of each TPDO.
    """

    def __init__(
        self,
        node: int,
        *,
        device_type: int,
        name: str,
        identity: tuple[int, int, int, int],
        mappings: tuple[tuple[int, ...], ...],
    ) -> None:
        self.node = node
        self.state = NmtState.BOOT_UP
        self.dictionary = ObjectDictionary()
        self._boot_at = math.inf
        self._heartbeat_at = math.inf
        self._now = 0.0
        self._error_register = 0
        self._errors: list[int] = []
        self._out: list[Frame] = []
        self._reset_pending = False
        self._stored: dict[tuple[int, int], Value] = {}
        self._sdo = SdoServer(self.dictionary)
        self._muted_until = -math.inf
        self._build(device_type, name, identity)
        self.tpdos = tuple(Tpdo(self.dictionary, node, number, words) for number, words in enumerate(mappings, 1))

    def _build(self, device_type: int, name: str, identity: tuple[int, int, int, int]) -> None:
        add = self.dictionary.add
        add(0x1000, 0, Entry(Kind.U32, device_type))
        add(0x1001, 0, Entry(Kind.U8, read=lambda: self._error_register, mappable=True))
        add(0x1003, 0, Entry(Kind.U8, access="rw", read=lambda: len(self._errors), write=self._clear_history))
        for sub in range(1, 5):
            add(0x1003, sub, Entry(Kind.U32, read=partial(self._history, sub)))
        add(0x1005, 0, Entry(Kind.U32, 0x80, access="rw", saved=True))
        add(0x1008, 0, Entry(Kind.STRING, name))
        add(0x1010, 0, Entry(Kind.U8, 1))
        add(0x1010, 1, Entry(Kind.U32, 1, access="rw", write=self._save))
        add(0x1011, 0, Entry(Kind.U8, 1))
        add(0x1011, 1, Entry(Kind.U32, 1, access="rw", write=self._load))
        add(0x1014, 0, Entry(Kind.U32, access="rw", read=lambda: 0x80 + self.node))
        add(0x1017, 0, Entry(Kind.U16, access="rw", saved=True, write=self._set_heartbeat))
        self.dictionary.record(0x1018, *(Entry(Kind.U32, value) for value in identity))

    # Actions of the device itself

    def power_on(self, now_s: float) -> None:
        """Boot with the stored parameters."""
        self._reset(now_s, communication_only=False)

    def mute(self, until_s: float) -> None:
        """Send and receive nothing until `until_s`, as with a broken cable."""
        self._muted_until = until_s

    def emergency(self, code: int, register: int, manufacturer: bytes = bytes(5)) -> None:
        """Report an error: EMCY, error register and history. Code 0 reports that all errors have cleared."""
        self._error_register = register if code else 0
        if code:
            self._errors.insert(0, code)
            del self._errors[4:]
        if self.state is not NmtState.STOPPED:
            data = code.to_bytes(2, "little") + bytes([self._error_register]) + manufacturer[:5].ljust(5, b"\0")
            self._out.append(Frame(0x80 + self.node, data))

    def commission(
        self, *, sync: bool, pdo: int, period_ms: int, heartbeat_ms: int, mapping: Sequence[int] = ()
    ) -> None:
        """Set and store parameters as at commissioning: one TPDO on SYNC or on its event timer, the others off.

        Args:
            sync: send the TPDO on SYNC, else on its event timer.
            pdo: number of the TPDO that is on.
            period_ms: period of its event timer.
            heartbeat_ms: heartbeat producer time.
            mapping: mapping of that TPDO, as words of object 1A00h; empty for the factory mapping.
        """
        for tpdo in self.tpdos:
            index, wanted = 0x1800 + tpdo.number - 1, tpdo.number == pdo
            cob_id = self.dictionary.value(index, 1) & 0x7FFFFFFF
            self.dictionary.put(index, 1, cob_id if wanted else cob_id | 0x80000000)
            if wanted:
                self.dictionary.put(index, 2, 1 if sync else 254)
                self.dictionary.put(index, 5, 0 if sync else period_ms)
                for sub, word in enumerate((len(mapping), *mapping) if mapping else ()):
                    self.dictionary.put(0x1A00 + tpdo.number - 1, sub, word)
        self.dictionary.put(0x1017, 0, heartbeat_ms)
        self._stored = self.dictionary.stored()

    # The bus

    def receive(self, frame: Frame, now_s: float) -> list[Frame]:
        """Process a frame; return the frames that the node sends in answer."""
        if now_s < self._muted_until:
            return []
        self._now = now_s
        if not frame.is_error and not frame.is_extended and self.state is not NmtState.BOOT_UP:
            self._hear(frame)
        frames = self._take()
        if self._reset_pending:
            self.reset()
        return frames

    def _hear(self, frame: Frame) -> None:
        cob_id, data = frame.arbitration_id, frame.data
        if frame.is_remote:
            for tpdo in self.tpdos:
                if self.state is NmtState.OPERATIONAL:
                    self._out += tpdo.remote(cob_id, self._now)
        elif cob_id == 0x000:
            if len(data) == 2 and data[1] in (0, self.node):
                self._command(data[0])
        elif cob_id == self.dictionary.value(0x1005) & 0x7FF:
            if self.state is NmtState.OPERATIONAL:
                for tpdo in self.tpdos:
                    self._out += tpdo.sync(self._now)
        elif cob_id == 0x600 + self.node and self.state is not NmtState.STOPPED:
            answer = self._sdo.respond(data)
            if answer is not None:
                self._out.append(Frame(0x580 + self.node, answer))

    def poll(self, now_s: float) -> list[Frame]:
        """Return the frames that are due."""
        self._now = now_s
        muted = now_s < self._muted_until
        if self.state is NmtState.BOOT_UP and now_s >= self._boot_at:
            self.state = NmtState.PRE_OPERATIONAL
            self._out.append(Frame(0x700 + self.node, b"\x00"))
            self._schedule_heartbeat(self._boot_at)
        if self.state is not NmtState.BOOT_UP and now_s >= self._heartbeat_at:
            self._out.append(Frame(0x700 + self.node, bytes([self.state])))
            self._schedule_heartbeat(self._heartbeat_at)
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                self._out += tpdo.poll(now_s)
        frames = self._take()
        return [] if muted else frames

    def next_deadline(self) -> float:
        """Return the instant at which `poll` is due."""
        if self.state is NmtState.BOOT_UP:
            return self._boot_at
        timers = [t.due_s for t in self.tpdos] if self.state is NmtState.OPERATIONAL else []
        return min([self._heartbeat_at, self._now if self._out else math.inf, *timers])

    def _take(self) -> list[Frame]:
        out, self._out = self._out, []
        return out

    def _command(self, command: int) -> None:
        if command == 0x01:
            if self.state is not NmtState.OPERATIONAL:
                for tpdo in self.tpdos:
                    tpdo.start(self._now)
            self.state = NmtState.OPERATIONAL
        elif command == 0x02:
            self.state = NmtState.STOPPED
        elif command == 0x80:
            self.state = NmtState.PRE_OPERATIONAL
        elif command in (0x81, 0x82):
            self._reset(self._now, communication_only=command == 0x82)

    # Resets and stored parameters

    def _reset(self, now_s: float, *, communication_only: bool) -> None:
        self.state = NmtState.BOOT_UP
        self._now = now_s
        self._boot_at = now_s + BOOT_S + self.node * 1e-3  # so that no two nodes start at the same instant
        self._heartbeat_at = math.inf
        self._sdo.reset()
        self._out.clear()
        self._reset_pending = False
        self._error_register = 0
        self.dictionary.restore(self._stored, communication_only=communication_only)
        if not communication_only:
            old = self.node
            self.after_reset()
            for tpdo in self.tpdos:
                tpdo.follow_node(old, self.node)

    def after_reset(self) -> None:
        """Apply restored parameters; a hook for profiles."""

    def save(self) -> None:
        """Store the parameters."""
        self._stored = self.dictionary.stored()

    def reset(self) -> None:
        """Reset like NMT command 81h."""
        self._reset(self._now, communication_only=False)

    def reset_after_answer(self) -> None:
        """Reset after the answer to the SDO request that caused the reset is sent."""
        self._reset_pending = True

    def _save(self, value: Value) -> None:
        if value != SAVE:
            raise AbortError(Abort.STORE)
        self.save()

    def _load(self, value: Value) -> None:
        if value != LOAD:
            raise AbortError(Abort.STORE)
        self._stored = {}  # factory values apply from the next reset on

    def _clear_history(self, value: Value) -> None:
        if value != 0:
            raise AbortError(Abort.VALUE)
        self._errors.clear()

    def _history(self, sub: int) -> int:
        if sub > len(self._errors):
            raise AbortError(Abort.NO_SUBINDEX)
        return self._errors[sub - 1]

    def _set_heartbeat(self, value: Value) -> None:
        self.dictionary.put(0x1017, 0, value)
        self._schedule_heartbeat(self._now)

    def _schedule_heartbeat(self, from_s: float) -> None:
        period_ms = self.dictionary.value(0x1017)
        self._heartbeat_at = from_s + period_ms / 1e3 if period_ms else math.inf
