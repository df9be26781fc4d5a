"""A CANopen object dictionary: typed entries with access rights, and the abort codes of refused accesses."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum

Value = int | float | str


class Abort(IntEnum):
    """SDO abort codes (CiA 301, table 22)."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    STORE = 0x08000020
    DEVICE_STATE = 0x08000022


class AbortError(Exception):
    """The device refuses an access."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code.name} {code:08X}h")
        self.code = code


class Kind(IntEnum):
    """Data types (CiA 301, table 44)."""

    I8 = 0x02
    I16 = 0x03
    I32 = 0x04
    U8 = 0x05
    U16 = 0x06
    U32 = 0x07
    REAL32 = 0x08
    STRING = 0x09


_FORMATS = {
    Kind.I8: "<b",
    Kind.I16: "<h",
    Kind.I32: "<i",
    Kind.U8: "<B",
    Kind.U16: "<H",
    Kind.U32: "<I",
    Kind.REAL32: "<f",
}


@dataclass
class Entry:
    """One sub-index.

    Attributes:
        kind: data type.
        value: current value, unless `read` computes it.
        access: `ro`, `rw` or `wo`.
        mappable: the entry may be mapped into a TPDO.
        saved: the value survives a reset once stored.
        read: function that computes the value at each access.
        write: called with the new value instead of storing it; may raise AbortError.
    """

    kind: Kind
    value: Value = 0
    access: str = "ro"
    mappable: bool = False
    saved: bool = False
    read: Callable[[], Value] | None = None
    write: Callable[[Value], None] | None = None

    @property
    def size(self) -> int | None:
        """Size of the value in bytes; None for strings."""
        return None if self.kind is Kind.STRING else struct.calcsize(_FORMATS[self.kind])

    def current(self) -> Value:
        """Return the current value."""
        return self.value if self.read is None else self.read()

    def encode(self) -> bytes:
        """Return the current value as bytes, little endian."""
        value = self.current()
        if self.kind is Kind.STRING:
            return str(value).encode("ascii")
        return struct.pack(_FORMATS[self.kind], value)

    def decode(self, data: bytes) -> Value:
        """Decode bytes of the entry's size."""
        value: Value = struct.unpack(_FORMATS[self.kind], data)[0]
        return value


class ObjectDictionary:
    """Entries by (index, sub-index)."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, int], Entry] = {}
        self._indices: set[int] = set()
        self._factory: dict[tuple[int, int], Value] = {}

    def add(self, index: int, sub: int, entry: Entry) -> Entry:
        """Add or replace an entry; its current value becomes the factory value."""
        self._entries[index, sub] = entry
        self._indices.add(index)
        self._factory[index, sub] = entry.value
        return entry

    def record(self, index: int, *entries: Entry) -> None:
        """Add entries at sub-indices 1, 2, ...; sub-index 0 holds their number."""
        self.add(index, 0, Entry(Kind.U8, len(entries)))
        for sub, entry in enumerate(entries, 1):
            self.add(index, sub, entry)

    def entry(self, index: int, sub: int) -> Entry:
        """Return an entry; AbortError if there is none."""
        entry = self._entries.get((index, sub))
        if entry is None:
            raise AbortError(Abort.NO_SUBINDEX if index in self._indices else Abort.NO_OBJECT)
        return entry

    def value(self, index: int, sub: int = 0) -> int:
        """Return the value of an integer entry."""
        return int(self.entry(index, sub).current())

    def put(self, index: int, sub: int, value: Value) -> None:
        """Set a value as the device itself, regardless of access rights."""
        self.entry(index, sub).value = value

    def read(self, index: int, sub: int) -> bytes:
        """Answer an SDO upload; AbortError if refused."""
        entry = self.entry(index, sub)
        if entry.access == "wo":
            raise AbortError(Abort.WRITE_ONLY)
        return entry.encode()

    def download(self, index: int, sub: int, data: bytes, *, size_given: bool) -> None:
        """Carry out an expedited SDO download.

        Args:
            index: index of the object.
            sub: sub-index.
            data: bytes of the given size, or all four bytes if no size was given (command 22h: devices use as many as
                they need).
            size_given: the command states the number of bytes.

        Raises:
            AbortError: the access is refused.
        """
        entry = self.entry(index, sub)
        if entry.access == "ro":
            raise AbortError(Abort.READ_ONLY)
        size = entry.size
        if size is None:
            raise AbortError(Abort.LENGTH)
        if not size_given:
            data = data[:size]
        if len(data) != size:
            raise AbortError(Abort.TOO_LONG if len(data) > size else Abort.TOO_SHORT)
        value = entry.decode(data)
        if entry.write is not None:
            entry.write(value)
        else:
            entry.value = value

    def stored(self) -> dict[tuple[int, int], Value]:
        """Return the values that a save command stores."""
        return {key: e.value for key, e in self._saved()}

    def restore(self, values: dict[tuple[int, int], Value], *, communication_only: bool = False) -> None:
        """Load stored values like a reset, and factory values for entries that were never stored."""
        for key, entry in self._saved():
            if communication_only and not 0x1000 <= key[0] < 0x2000:
                continue
            entry.value = values.get(key, self._factory[key])

    def _saved(self) -> Iterator[tuple[tuple[int, int], Entry]]:
        return ((key, e) for key, e in self._entries.items() if e.saved)
