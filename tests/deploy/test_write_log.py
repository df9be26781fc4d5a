"""The disk that a power cut leaves, of QEMU's log of writes: nothing flushed is missing, nothing later is there."""

import io
import random
import struct
from pathlib import Path

import pytest

from tests.vm.write_log import SECTOR, WriteLog

FLUSH = 1


def log_of(path: Path, *entries: tuple[int, bytes, int]) -> WriteLog:
    """A log of writes: first sector, data, flags."""
    blocks = [struct.pack("<QQQI", 0x6A736677736872, 1, len(entries), SECTOR).ljust(SECTOR, b"\0")]
    for sector, data, flags in entries:
        blocks += [struct.pack("<QQQQ", sector, len(data) // SECTOR, flags, 0).ljust(SECTOR, b"\0"), data]
    path.write_bytes(b"".join(blocks))
    return WriteLog(path)


def test_what_was_flushed_is_on_the_disk_and_of_the_rest_whole_sectors(tmp_path: Path) -> None:
    old, new, late = (bytes([n]) * (4 * SECTOR) for n in (1, 2, 3))
    log = log_of(tmp_path / "log", (0, old, 0), (0, b"", FLUSH), (0, new, 0), (4, late, 0))
    assert log.last_flush(2) == 1
    seen = set()
    for seed in range(40):
        disk = io.BytesIO(bytes(8 * SECTOR))
        log.apply(disk, 0, 2)
        log.apply_part(disk, 2, 3, random.Random(seed))
        data = disk.getvalue()
        sectors = [data[at : at + SECTOR] for at in range(0, len(data), SECTOR)]
        assert all(sector in (old[:SECTOR], new[:SECTOR]) for sector in sectors[:4]), "a sector is torn, or lost"
        assert sectors[4:] == [bytes(SECTOR)] * 4, "what was written after the cut is there"
        seen.add(sum(sector == new[:SECTOR] for sector in sectors[:4]))
    assert {0, 4} < seen, "writes are kept whole, lost whole, and torn"
    log.close()


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(bytes(SECTOR))
    with pytest.raises(ValueError, match="no log of writes"):
        WriteLog(tmp_path / "log")
