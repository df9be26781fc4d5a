"""A transmit PDO of a simulated node (CiA 301, 7.2.2): transmission types, timers, mapping, and rules for changes."""

from __future__ import annotations

import math
from functools import partial

from simulators.devices.can.bus import Frame
from simulators.devices.can.object_dictionary import Abort, AbortError, Entry, Kind, ObjectDictionary, Value

NOT_VALID = 0x80000000
NO_REMOTE = 0x40000000
_COB_BASES = (0x180, 0x280, 0x380, 0x480)
_MAP_LIMIT = 4  # objects a PDO of these devices can hold


class Tpdo:
    """One TPDO: communication parameters at 1800h, mapping at 1A00h (plus the TPDO's number minus one).

    Like real devices, it refuses (08000022h) a new COB-ID, transmission type, inhibit time or mapping while it is
    valid. Its event timer may change at any time.

    Args:
        dictionary: object dictionary of the node.
        node: node number.
        number: number of the TPDO, 1 to 4.
        words: factory mapping words.
    """

    def __init__(self, dictionary: ObjectDictionary, node: int, number: int, words: tuple[int, ...]) -> None:
        self.number = number
        self.due_s = math.inf
        self._dictionary = dictionary
        self._now = 0.0
        self._last_sent_s = -math.inf
        self._syncs = 0
        self._last_data = b""
        self._sampled = b""
        add, index = self._dictionary.add, 0x1800 + number - 1
        self._communication, self._mapping = index, 0x1A00 + number - 1
        add(index, 0, Entry(Kind.U8, 5))
        cob_id = _COB_BASES[number - 1] + node
        add(index, 1, Entry(Kind.U32, cob_id, access="rw", saved=True, write=self._write_cob_id))
        first = 254 if number == 1 else 1
        add(index, 2, Entry(Kind.U8, first, access="rw", saved=True, write=self._write_type))
        add(index, 3, Entry(Kind.U16, 0, access="rw", saved=True, write=self._write_inhibit))
        add(index, 4, Entry(Kind.U8, 0, access="rw"))
        add(index, 5, Entry(Kind.U16, 0, access="rw", saved=True, write=self.write_timer))
        add(self._mapping, 0, Entry(Kind.U8, len(words), access="rw", saved=True, write=self._write_count))
        for sub in range(1, _MAP_LIMIT + 1):
            word = words[sub - 1] if sub <= len(words) else 0
            write = partial(self._write_word, sub)
            add(self._mapping, sub, Entry(Kind.U32, word, access="rw", saved=True, write=write))

    @property
    def timer_ms(self) -> int:
        """Event timer in ms; 0 if it is off."""
        return self._dictionary.value(self._communication, 5)

    @property
    def _cob_id(self) -> int:
        return self._dictionary.value(self._communication, 1)

    @property
    def _valid(self) -> bool:
        return not self._cob_id & NOT_VALID

    @property
    def _type(self) -> int:
        return self._dictionary.value(self._communication, 2)

    # Sending

    def start(self, now_s: float) -> None:
        """Start sending, because the node became operational."""
        self._now, self._syncs, self._last_data, self._last_sent_s = now_s, 0, b"", -math.inf
        self._schedule(now_s)

    def sync(self, now_s: float) -> list[Frame]:
        """Return the frames that a SYNC triggers."""
        self._now = now_s
        if not self._valid:
            return []
        kind = self._type
        if kind == 252:
            self._sampled = self._data()
        elif 1 <= kind <= 240:
            self._syncs += 1
            if self._syncs >= kind:
                self._syncs = 0
                return [self._send(self._data())]
        elif kind == 0:
            data = self._data()
            if data != self._last_data:
                return [self._send(data)]
        return []

    def remote(self, cob_id: int, now_s: float) -> list[Frame]:
        """Return the frames that a remote frame triggers."""
        self._now = now_s
        if not self._valid or self._cob_id & NO_REMOTE or cob_id != self._cob_id & 0x7FF:
            return []
        return [self._send(self._sampled if self._type == 252 else self._data())]

    def poll(self, now_s: float) -> list[Frame]:
        """Return the frames that the event timer triggers."""
        self._now = now_s
        if now_s < self.due_s:
            return []
        due = self.due_s
        frame = self._send(self._data())
        # Without drift, but also without a burst for missed instants
        self._schedule(due if now_s - due < self.timer_ms / 1e3 else now_s)
        return [frame]

    def _schedule(self, from_s: float) -> None:
        if not self._valid or self._type < 254 or not self.timer_ms:
            self.due_s = math.inf
            return
        inhibit_s = self._dictionary.value(self._communication, 3) * 1e-4
        self.due_s = max(from_s + self.timer_ms / 1e3, self._last_sent_s + inhibit_s)

    def _send(self, data: bytes) -> Frame:
        self._last_data, self._last_sent_s = data, self._now
        return Frame(self._cob_id & 0x7FF, data)

    def _data(self) -> bytes:
        out = b""
        for sub in range(1, self._dictionary.value(self._mapping) + 1):
            word = self._dictionary.value(self._mapping, sub)
            out += self._dictionary.entry(word >> 16, word >> 8 & 0xFF).encode()
        return out

    # Changing parameters

    def _changeable(self) -> None:
        if self._valid:
            raise AbortError(Abort.DEVICE_STATE)

    def _write_cob_id(self, value: Value) -> None:
        new = int(value)
        if self._valid and not new & NOT_VALID and (new ^ self._cob_id) & 0x3FFFFFFF:
            raise AbortError(Abort.DEVICE_STATE)
        self._dictionary.put(self._communication, 1, new)
        self._schedule(self._now)

    def _write_type(self, value: Value) -> None:
        self._changeable()
        if 241 <= int(value) <= 251:
            raise AbortError(Abort.VALUE)
        self._dictionary.put(self._communication, 2, value)

    def _write_inhibit(self, value: Value) -> None:
        self._changeable()
        self._dictionary.put(self._communication, 3, value)

    def write_timer(self, value: Value) -> None:
        """Set the event timer in ms, on a write to 1800h.5 or to an alias of it."""
        self._dictionary.put(self._communication, 5, value)
        self._schedule(self._now)

    def follow_node(self, old: int, new: int) -> None:
        """Adapt the COB-ID to a changed node number, unless it was set to a non-default value."""
        cob_id = self._cob_id
        base = _COB_BASES[self.number - 1]
        if cob_id & 0x7FF == base + old:
            self._dictionary.put(self._communication, 1, cob_id & ~0x7FF | base + new)

    def _write_word(self, sub: int, value: Value) -> None:
        # Allowed only while the count is 0
        self._changeable()
        if self._dictionary.value(self._mapping):
            raise AbortError(Abort.DEVICE_STATE)
        word = int(value)
        if word:
            try:
                entry = self._dictionary.entry(word >> 16, word >> 8 & 0xFF)
            except AbortError:
                raise AbortError(Abort.NO_OBJECT) from None
            if not entry.mappable or entry.size is None or entry.size * 8 != word & 0xFF:
                raise AbortError(Abort.NOT_MAPPABLE)
        self._dictionary.put(self._mapping, sub, word)

    def _write_count(self, value: Value) -> None:
        self._changeable()
        count = int(value)
        if count > _MAP_LIMIT:
            raise AbortError(Abort.VALUE_HIGH)
        words = [self._dictionary.value(self._mapping, sub) for sub in range(1, count + 1)]
        if not all(words):
            raise AbortError(Abort.NOT_MAPPABLE)
        if sum(word & 0xFF for word in words) > 64:
            raise AbortError(Abort.PDO_LENGTH)
        self._dictionary.put(self._mapping, 0, count)
