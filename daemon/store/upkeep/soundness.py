"""Soundness of a store: SQLite's own check, the checksum of every chunk of captures, the live models."""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sqlite_utils import Database

from daemon.store.captures import require_sound
from daemon.store.errors import DamagedChunkError, StoreError, storage_errors
from daemon.store.migrations import unknown_migrations
from daemon.store.reader import Reader
from daemon.store.upkeep.model_places import place_of_model

MOST_FINDINGS = 20
MANIFEST = "manifest.json"

# A retired model may have been deleted by hand; a store without its live model is incomplete.
_MODELS = """SELECT id, path, manifest_sha256 FROM models WHERE state = 'live' ORDER BY id"""


@dataclass(frozen=True)
class Soundness:
    """Result of the check of a store.

    Attributes:
        findings: what is wrong, one clause per finding; empty for a sound store.
        chunks: number of chunks of captures.
        captures: number of captures in them.
        models: number of live models whose files were checked.
    """

    findings: tuple[str, ...]
    chunks: int
    captures: int
    models: int


def check_store(path: Path, models: Path | None, go_on: Callable[[], None] = lambda: None) -> Soundness:
    """Check a store for damage; the daemon may write to it meanwhile.

    Args:
        path: the database.
        models: directory of the models, under their names in the store; None to skip their check.
        go_on: called repeatedly; an exception that it raises ends the check.

    Raises:
        StoreError: the store cannot be opened, or was made by a newer rigcal.
    """
    findings: list[str] = []
    chunks = captures = looked_at = 0
    require_known(path)
    with storage_errors(path), contextlib.closing(Reader(path)) as reader:
        reader.interrupt_by(go_on)
        try:
            found = [str(row["integrity_check"]) for row in reader.rows(f"PRAGMA integrity_check({MOST_FINDINGS})")]
            findings += [" ".join(line.split()) for line in found if line != "ok"]
            findings += [
                f"a row of {row['table']} refers to a missing row of {row['parent']}"
                for row in reader.rows("PRAGMA foreign_key_check")
            ][:MOST_FINDINGS]
            for row in reader.rows("SELECT id, captures, chunk FROM raw_chunks ORDER BY id"):
                chunks, captures = chunks + 1, captures + row["captures"]
                try:
                    require_sound(row["chunk"])
                except StoreError as error:
                    what = error.what if isinstance(error, DamagedChunkError) else error
                    findings.append(f"raw chunk {row['id']}: {what}")
            if models is not None:
                for row in reader.rows(_MODELS):
                    looked_at += 1
                    place = place_of_model(row["path"]) or Path(row["path"]).name
                    findings += _model_findings(row["id"], models / place, row["manifest_sha256"])
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorname == "SQLITE_INTERRUPT":
                go_on()
            findings.append(str(error))
    return Soundness(tuple(findings[:MOST_FINDINGS]), chunks, captures, looked_at)


def require_known(path: Path) -> None:
    """Raise StoreError if there is no store, or a newer program has made it."""
    if not path.is_file():
        raise StoreError(f"{path}: there is no store")
    with (
        storage_errors(path),
        contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db,
    ):
        if later := unknown_migrations(Database(db)):
            raise StoreError(f"{path}: made by a newer rigcal (it has {later[0]}); install that version")


def _model_findings(number: int, directory: Path, manifest_sha256: str) -> list[str]:
    try:
        found = hashlib.sha256((directory / MANIFEST).read_bytes()).hexdigest()
    except OSError as error:
        return [f"model {number}: {directory / MANIFEST} cannot be read ({error.strerror})"]
    return [] if found == manifest_sha256 else [f"model {number}: {directory} contains a different model"]
