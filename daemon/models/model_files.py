"""Model directories: written whole or not at all, read only after their first load has gone well in another process.

A model is a handful of files under a manifest (`calibration.model.files`). Whatever they may hold, no process of value
parses a model that a child has not parsed before it. That takes a second or two: a model whose sum was kept when it
was written is not parsed by another child.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from calibration.errors import CalibrationError, ModelError, UnsafeError
from calibration.model.files import MANIFEST, check_manifest, model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.rig.description import Rig
from daemon.host.safe_output import write_file
from daemon.models.first_load import IS_NO_MODEL, encode
from daemon.store.errors import LACKING
from drivers.files import read_whole

REPORT = "report.html"
COMPANIONS = frozenset({REPORT})  # may lie beside the model's files, outside its manifest
CHECK_TIMEOUT_S = 120.0
_MODEL_MAX_BYTES = 64 << 20  # all files together; the most trees that are ever grown take 20 MB
_MANIFEST_MAX_BYTES = 1 << 20
_FILES_MAX = 32
_FILE_NAME = re.compile(r"\w[\w.-]{0,99}", re.ASCII)
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2

_checked: set[str] = set()  # manifests of models that a child of this process has loaded


def check_target(directory: Path) -> None:
    """Check that a model may be written to `directory`: nothing there, an empty directory, or a model to be replaced.

    Raises:
        ModelError: something else is there that would be lost, or no directory can be made there.
    """
    require_place(directory)
    if not directory.exists():
        return
    if not directory.is_dir():
        raise ModelError(f"{directory} is a file; name a directory for the model")
    found = {path.name for path in directory.iterdir()}
    if not found:
        return
    if MANIFEST not in found:
        raise ModelError(f"{directory} is neither empty nor a model directory; name another one")
    foreign = sorted(found - set(_listed(directory)) - COMPANIONS - {MANIFEST})
    if foreign:
        raise ModelError(f"{directory} holds {foreign[0]!r}, which is no part of the model there; move it away first")


def require_place(directory: Path) -> None:
    """Raise ModelError where no directory can be made, or put in the place of one that is there."""
    nearest = next(path for path in directory.resolve().parents if path.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        reason = "may not be written to" if nearest.is_dir() else "is a file"
        raise ModelError(f"{directory} cannot be made, as {nearest} {reason}; name another directory")


def check_loads(model: CalibratedModel, directory: Path) -> None:
    """Let a child process load a model that is to be written to a directory, so that `write_model` need not.

    Raises:
        ModelError: the model does not load.
    """
    _check_in_child(model_to_files(model), directory.resolve())


def write_model(directory: Path, model: CalibratedModel, companions: Mapping[str, bytes] | None = None) -> str:
    """Write a model directory; a model already there is replaced in one step, so that a reader sees one or the other.

    The new files are loaded by a child process, written beside the directory, flushed to disk, and renamed.

    Args:
        directory: where to; parents are made.
        model: what to write.
        companions: files to lie beside the model's, of the names in `COMPANIONS`.

    Returns:
        SHA-256 of the manifest, which names the model.

    Raises:
        ModelError: `directory` holds something else, or the model does not load again.
        OSError: the file system refuses.
    """
    directory = directory.resolve()
    check_target(directory)
    files = model_to_files(model)
    _check_in_child(files, directory)
    with replaced_whole(directory) as new:
        for name, data in {**files, **(companions or {})}.items():
            write_file(new / name, data)
    return _sha256(files[MANIFEST])


@contextlib.contextmanager
def replaced_whole(directory: Path) -> Iterator[Path]:
    """A new directory beside `directory`, which takes its place in one step when the block ends well.

    Raises:
        OSError: the file system refuses; `directory` is as it was.
    """
    directory = directory.resolve()
    directory.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".rigcal-", dir=directory.parent) as scratch:
        new = Path(scratch) / "new"
        new.mkdir()
        yield new
        _sync_directory(new)
        _put_in_place(new, directory)
        _sync_directory(directory.parent)


def read_model(directory: Path, manifest_sha256: str | None = None) -> CalibratedModel:
    """Read a model directory; one that this process meets without its sum is loaded by a child process first.

    Args:
        directory: the model's.
        manifest_sha256: which model is meant, as `write_model` gave it once a child had loaded that model; whichever is
            there when not given.

    Raises:
        ModelError: not a model, truncated, edited, of another version, or it brings down the process that loads it.
        CalibrationError: this machine lacks what loading it needs, or its disk fails.
    """
    if not directory.is_dir():
        raise ModelError(f"{directory} is not a directory; name the one that calibrate wrote")
    if not (directory / MANIFEST).is_file():
        raise ModelError(f"{directory} is not a model directory: it has no {MANIFEST}")
    files: dict[str, bytes] = {}
    for name in (MANIFEST, *_listed(directory)):
        data = _read(directory, name, _MODEL_MAX_BYTES - sum(map(len, files.values())))
        if data is not None:
            files[name] = data
    if manifest_sha256 is not None and _sha256(files[MANIFEST]) != manifest_sha256:
        raise ModelError(f"{directory} does not hold the model that was written there; restore it")
    try:
        check_manifest(files)
    except ModelError as error:
        raise ModelError(f"{directory}: {error}") from error
    if manifest_sha256 is None:
        _check_in_child(files, directory)
    return model_from_files(files)


def read_model_of_rig(directory: Path, manifest_sha256: str, rig: Rig) -> CalibratedModel:
    """Read the model that a store knows, for use on a rig.

    Raises:
        CalibrationError: as `read_model`.
        UnsafeError: it was made for another rig file: names, joints, rows, limits or channels differ.
            Comments and signals may.
    """
    model = read_model(directory, manifest_sha256)
    if model.rig.differences(rig):
        raise UnsafeError(
            f"{directory} was made for another rig file (of {model.rig.name!r}) than the one in use (of {rig.name!r}), "
            "and they differ in what they describe; calibrate with this one, or go back to that one"
        )
    return model


def model_sha256(directory: Path) -> str:
    """SHA-256 of the manifest, which names the model; ModelError if there is none."""
    data = _read(directory, MANIFEST, _MANIFEST_MAX_BYTES)
    if data is None:
        raise ModelError(f"{directory} is not a model directory: it has no {MANIFEST}")
    return _sha256(data)


def _listed(directory: Path) -> list[str]:
    """Names of the files in the manifest, which need not be sound otherwise."""
    try:
        names = list(json.loads(_read(directory, MANIFEST, _MANIFEST_MAX_BYTES) or b"")["files"])
    except (ValueError, KeyError, TypeError, RecursionError, MemoryError) as error:
        raise ModelError(f"{directory}: {MANIFEST} is damaged; restore the model, or remove it") from error
    if len(names) > _FILES_MAX:
        raise ModelError(f"{directory}: {MANIFEST} lists {len(names)} files, a model has {_FILES_MAX} at most")
    for name in names:
        if not (isinstance(name, str) and _FILE_NAME.fullmatch(name)):
            raise ModelError(f"{directory}: {MANIFEST} lists {name!r}, which is no file name; this is not a model")
    return names


def _read(directory: Path, name: str, most_bytes: int) -> bytes | None:
    """The file's bytes; None if there is none; as `read_model` where it is no part of a model, or cannot be read."""
    path = directory / name
    if path.exists() and not path.is_file():
        raise ModelError(f"{directory}: {name} is not a regular file; this is not a model")
    try:
        return read_whole(path, most_bytes)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise ModelError(
                f"{directory}: with {name} it is larger than a model can be ({_MODEL_MAX_BYTES:,} bytes)"
            ) from error
        kind = CalibrationError if error.errno in LACKING or error.errno == errno.EIO else ModelError
        raise kind(f"{directory}: {name} cannot be read: {error.strerror}") from error


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _check_in_child(files: Mapping[str, bytes], directory: Path) -> None:
    """Let a fresh process load the files and predict with them; an error in one sentence if that ends badly."""
    key = _sha256(files[MANIFEST])
    if key in _checked:
        return
    # -P keeps the current directory off the child's path: what lies there is no code of ours.
    command = [sys.executable, "-P", "-m", "daemon.models.first_load"]
    try:
        # In a session of its own: a Ctrl-C that is meant for this process would look like a model that kills the child.
        child = subprocess.run(
            command,
            input=encode(files),
            capture_output=True,
            timeout=CHECK_TIMEOUT_S,
            check=False,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired as error:
        raise ModelError(f"{directory}: loading the model did not end within {CHECK_TIMEOUT_S:g} s") from error
    if child.returncode < 0:
        name = signal.Signals(-child.returncode).name
        raise ModelError(f"{directory}: the model kills the process that loads it ({name}); restore it")
    if child.returncode != 0:
        lines = child.stderr.decode("utf-8", "replace").strip().splitlines() or ["no reason given"]
        kind = ModelError if child.returncode == IS_NO_MODEL else CalibrationError
        raise kind(f"{directory}: {lines[-1]}")
    _checked.add(key)


def _put_in_place(new: Path, target: Path) -> None:
    """Rename `new` to `target`; what was at `target` then lies in `new`'s directory, or is gone if it was empty."""
    try:
        new.rename(target)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        if not _exchange(new, target):
            # A file system that cannot swap (NFS, some FUSE): for an instant a reader may find nothing.
            target.rename(new.with_name("old"))
            new.rename(target)


def _exchange(one: Path, other: Path) -> bool:
    """Swap two directories in one step (Linux, renameat2(2)); False where the file system cannot."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        return False
    raise OSError(code, os.strerror(code), str(other))


def _sync_directory(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
