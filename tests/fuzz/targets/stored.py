"""Captures in the store, backups, arrays of a checkpoint, and what a job's process says."""

from __future__ import annotations

import random
import struct
import zlib
from contextlib import suppress

import numpy as np

from calibration.identification.search.checkpoint import unpack
from calibration.numerics.stored_arrays import read_npz
from daemon.jobs.order import parse_message
from daemon.store.captures import decode_captures
from daemon.store.errors import StoreError
from daemon.store.packed_captures import unpacked
from daemon.store.upkeep.backup import ABOUT, read_backup
from tests.fuzz.mutate import change
from tests.fuzz.target import Run, Target, check_refusal, scratch_directory

_HEADER = struct.Struct("<4sBBBxIIHH")


def _captures() -> Run:
    def run(data: bytes) -> None:
        try:
            decode_captures(data)
        except StoreError as error:
            check_refusal(error)

    return run


def _packed() -> Run:
    def run(data: bytes) -> None:
        """Take a body behind one byte that says whether it is serial, and two that count its captures."""
        if len(data) < 3:
            return
        with suppress(ValueError, IndexError, struct.error):
            found = unpacked(data[3:], int.from_bytes(data[1:3], "little"), is_serial=bool(data[0] & 1))
            assert found.length.sum() == len(found.payload)

    return run


def _backup() -> Run:
    folder = scratch_directory()

    def run(data: bytes) -> None:
        (folder / ABOUT).write_bytes(data)
        try:
            read_backup(folder)
        except StoreError as error:
            check_refusal(error, str(folder))

    return run


def _changed_chunk(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    """Change the header or what is packed, which is packed again."""
    if len(data) < _HEADER.size + 4:
        return change(rng, "bytes", data, corpus)
    head, names = data[: _HEADER.size], sum(_HEADER.unpack_from(data)[-2:])
    rest = data[_HEADER.size : -4]
    packing = data[6]
    body = rest[names:]
    if packing == 1:
        with suppress(zlib.error):
            body = zlib.decompressobj().decompress(body, 1 << 20)
    if rng.random() < 0.4:
        head = change(rng, "bytes", head, [])[: _HEADER.size].ljust(_HEADER.size, b"\0")
    else:
        body = change(rng, "bytes", body, corpus)
    return head + rest[:names] + (zlib.compress(body, 1) if packing == 1 else body) + data[-4:]


def _crc(rng: random.Random, data: bytes) -> bytes:
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def _npz() -> Run:
    def run(data: bytes) -> None:
        try:
            arrays = read_npz(data)
        except ValueError:
            pass
        else:
            assert sum(array.nbytes for array in arrays.values()) <= len(data)

    return run


def _checkpoint() -> Run:
    identity = {"seed": np.array("1"), "data": np.zeros(3)}
    return lambda data: assert_told(unpack(data, identity))


def assert_told(found: tuple[object, str | None]) -> None:
    """What is left aside is said."""
    assert (found[0] is None) == (found[1] is not None)


def _message() -> Run:
    def run(data: bytes) -> None:
        parse_message(data)

    return run


TARGETS = [
    Target("packed-captures", _packed, is_slow=True),
    Target("backup", _backup, "json", is_slow=True),
    Target("captures", _captures, change=_changed_chunk, repair=_crc, is_slow=True),
    Target(
        "npz",
        _npz,
        words=(b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999,), }", b"|O", b"PK\x03\x04"),
        is_slow=True,
    ),
    Target("checkpoint", _checkpoint, is_slow=True),
    Target("job-message", _message, "json"),
]
