"""Packing of small chunks of captures, as committed by acquisition, into large ones, which need much less space."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from daemon.store.captures import CaptureRun, Chunk, decode_run, encode_large
from daemon.store.errors import StoreError
from daemon.store.packed_captures import joined
from daemon.store.store import Store

log = logging.getLogger(__name__)

SPAN_NS = 60_000_000_000  # time span of a large chunk; newer captures stay in small chunks
MOST_CAPTURES = 100_000
_LOOKED_AT = 10_000  # small chunks read at a time

_SMALL = """SELECT raw_chunks.id, link_id, captures, first_boot_id AS boot, first_monotonic_ns AS first_ns,
        last_monotonic_ns AS last_ns, undecoded_chunks.chunk_id IS NOT NULL AS waits
    FROM small_chunks JOIN raw_chunks ON raw_chunks.id = small_chunks.chunk_id
    LEFT JOIN undecoded_chunks ON undecoded_chunks.chunk_id = small_chunks.chunk_id
    ORDER BY small_chunks.chunk_id LIMIT ?"""
_NEWEST = """SELECT last_boot_id AS boot, last_monotonic_ns AS last_ns FROM raw_chunks ORDER BY id DESC LIMIT 1"""
_LARGE = """UPDATE raw_chunks SET last_utc_ns = ?, last_monotonic_ns = ?, captures = ?, bytes = ?, chunk = ?
    WHERE id = ?"""

Row = dict[str, Any]


class Packing:
    """Packs the chunks of a store, one large chunk at a time.

    Before the small chunks are deleted, the large chunk is decoded and compared with them, byte for byte and stamp for
    stamp. The small chunks are replaced in one transaction, so that a kill or a power cut leaves either all of them or
    the large one.

    Args:
        store: the database, open for writing.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def pack_next(self) -> bool:
        """Make one large chunk, if there are small chunks for it.

        Returns:
            Whether there may be more.

        Raises:
            sqlite3.Error, StoreError: the store cannot be read or written; it is unchanged.
        """
        run = self._due()
        if not run:
            return False
        ids = [row["id"] for row in run]
        blobs = [self._chunk(number) for number in ids]
        try:
            large = packed_run([decode_run(blob) for blob in blobs]) if len(blobs) > 1 else None
        except StoreError as error:
            log.error("%s: raw chunks %d to %d are not packed: %s", self._store.path, ids[0], ids[-1], error)
            large = None
        if large is not None and len(large.blob) >= sum(map(len, blobs)):
            large = None
        with self._store.transaction() as db:
            marks = [(number,) for number in ids]
            db.conn.executemany("DELETE FROM small_chunks WHERE chunk_id = ?", marks)
            if large is not None:
                last = large.last
                values = last.utc_ns, last.monotonic_ns, large.captures, large.payload_bytes, large.blob, ids[0]
                changed = db.execute(_LARGE, values).rowcount
                changed += db.conn.executemany("DELETE FROM raw_chunks WHERE id = ?", marks[1:]).rowcount
                if changed != len(ids):
                    raise StoreError(
                        f"{self._store.path}: raw chunks {ids[0]} to {ids[-1]} changed while they were packed"
                    )
        return True

    def _chunk(self, number: int) -> bytes:
        (row,) = self._store.rows("SELECT chunk FROM raw_chunks WHERE id = ?", [number])
        return bytes(row["chunk"])

    def _due(self) -> Sequence[Row]:
        """Return the small chunks of one link and boot for the next large chunk; none if all chunks are too new."""
        newest = self._store.rows(_NEWEST)
        runs: dict[int, list[Row]] = {}  # by link
        for row in self._store.rows(_SMALL, [_LOOKED_AT]):
            run = runs.setdefault(row["link_id"], [])
            if run and (row["boot"] != run[0]["boot"] or _is_full(run)):
                return run
            if row["waits"]:
                break  # all later chunks wait as well
            run.append(row)
        for run in filter(None, runs.values()):
            age_ns = newest[0]["last_ns"] - run[-1]["last_ns"]
            if _is_full(run) or newest[0]["boot"] != run[0]["boot"] or age_ns > SPAN_NS:
                return run
        return []


def packed_run(small: Sequence[CaptureRun]) -> Chunk:
    """Return one large chunk with the captures of small chunks of one link and one boot.

    Raises:
        StoreError: the small chunks do not belong together, or the large chunk does not decode to the same captures.
    """
    run = CaptureRun(small[0].link, small[0].boot_id, small[0].is_serial, joined([own.columns for own in small]))
    if any((own.link, own.boot_id, own.is_serial) != (run.link, run.boot_id, run.is_serial) for own in small):
        raise StoreError("their links or boots differ from those in their rows")
    chunk = encode_large(run)
    again = decode_run(chunk.blob)
    if (again.link, again.boot_id, again.is_serial) != (run.link, run.boot_id, run.is_serial) or not (
        again.columns.equals(run.columns)
    ):
        raise StoreError("decoding the packed chunk gives different captures; this is a fault of rigcal: report it")
    return chunk


def _is_full(run: Sequence[Row]) -> bool:
    span_ns: int = run[-1]["last_ns"] - run[0]["first_ns"]
    return span_ns >= SPAN_NS or sum(row["captures"] for row in run) >= MOST_CAPTURES
