"""QEMU's log of every write and flush of a disk, and the disk as a power cut would have left it at any of them.

The format is that of dm-log-writes, as QEMU's driver `blklogwrites` writes it. What was flushed before the cut is on
the disk; of what was written after the last flush, a volatile cache has put down a part at random, in sectors, so that
writes are torn as well.
"""

from __future__ import annotations

import random
import struct
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

SECTOR = 512
_MAGIC, _VERSION = 0x6A736677736872, 1
_FLUSH, _DISCARD = 1, 4
_SUPER, _ENTRY = struct.Struct("<QQQI"), struct.Struct("<QQQQ")


@dataclass(frozen=True)
class Entry:
    """A write, a flush, or both.

    Attributes:
        at: where on the disk, bytes.
        size: how much, bytes; 0 of a mere flush.
        flags: what it is.
        place: of its data in the log.
    """

    at: int
    size: int
    flags: int
    place: int

    @property
    def is_flush(self) -> bool:
        """All that was written before is on the disk."""
        return bool(self.flags & _FLUSH)

    @property
    def is_discard(self) -> bool:
        """The sectors were given up: they read as zeros."""
        return bool(self.flags & _DISCARD)


class WriteLog:
    """A log that is complete.

    Args:
        path: of the log.

    Attributes:
        entries: in their order.

    Raises:
        ValueError: it is no log of writes.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        head = self._file.read(_SUPER.size)
        magic, version, count, sector = _SUPER.unpack(head) if len(head) == _SUPER.size else (0, 0, 0, 0)
        if magic != _MAGIC or version != _VERSION:
            self._file.close()
            raise ValueError(f"{path}: no log of writes")
        self.entries: list[Entry] = []
        place = sector
        for _ in range(count):
            self._file.seek(place)
            at, n, flags, _ = _ENTRY.unpack(self._file.read(_ENTRY.size))
            entry = Entry(at * sector, n * sector, flags, place + sector)
            self.entries.append(entry)
            place = entry.place + (0 if entry.is_discard else entry.size)
        self._flushes = [number for number, entry in enumerate(self.entries) if entry.is_flush]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def data(self, entry: Entry) -> bytes:
        """Return what was written."""
        if entry.is_discard:
            return bytes(entry.size)
        self._file.seek(entry.place)
        return self._file.read(entry.size)

    def last_flush(self, cut: int) -> int:
        """Return the number of the last flush up to the entry `cut`; -1 where there is none."""
        found = bisect_right(self._flushes, cut)
        return self._flushes[found - 1] if found else -1

    def apply(self, disk: BinaryIO, first: int, after: int) -> None:
        """Write the entries `first` up to but not including `after` to a disk."""
        for entry in self.entries[first:after]:
            disk.seek(entry.at)
            disk.write(self.data(entry))

    def apply_part(self, disk: BinaryIO, first: int, after: int, rng: random.Random) -> None:
        """Write a part of these entries' sectors, at random: none, some or all of them."""
        share = rng.choice((0.0, 0.5, 1.0))
        for entry in self.entries[first:after]:
            data = self.data(entry)
            for offset in range(0, entry.size, SECTOR):
                if rng.random() < share:
                    disk.seek(entry.at + offset)
                    disk.write(data[offset : offset + SECTOR])
