"""Model directories: written atomically, and read only after a child process has loaded them successfully.

A model is a few files listed in a manifest (`calibration.model.files`). Whatever they contain, no important process
parses a model that a child process has not parsed before. This takes a second or two, so it is skipped for a model
whose checksum was stored when it was written.
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
COMPANIONS = frozenset({REPORT})  # files that may be in a model directory without being in the manifest
CHECK_TIMEOUT_S = 120.0
_MODEL_MAX_BYTES = 64 << 20  # all files together; the largest possible forest takes 20 MB
_MANIFEST_MAX_BYTES = 1 << 20
_FILES_MAX = 32
_FILE_NAME = re.compile(r"\w[\w.-]{0,99}", re.ASCII)
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2

_checked: set[str] = set()  # manifest checksums of models that a child of this process has loaded


def check_target(directory: Path) -> None:
    """Check that a model may be written to `directory`: it does not exist, is empty, or holds a model to be replaced.

    Raises:
        ModelError: other files there would be lost, or the directory cannot be created.
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
        raise ModelError(f"{directory} is neither empty nor a model directory; name a different directory")
    foreign = sorted(found - set(_listed(directory)) - COMPANIONS - {MANIFEST})
    if foreign:
        raise ModelError(f"{directory} contains {foreign[0]!r}, which is not part of its model; move that file first")


def require_place(directory: Path) -> None:
    """Raise ModelError if the directory can be neither created nor replaced."""
    nearest = next(path for path in directory.resolve().parents if path.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        reason = "is not writable" if nearest.is_dir() else "is a file"
        raise ModelError(f"{directory} cannot be created, because {nearest} {reason}; name a different directory")


def check_loads(model: CalibratedModel, directory: Path) -> None:
    """Let a child process load a model in advance, so that `write_model` need not do so.

    Args:
        model: to be written later.
        directory: its target, for error messages.

    Raises:
        ModelError: the model cannot be loaded.
    """
    _check_in_child(model_to_files(model), directory.resolve())


def write_model(directory: Path, model: CalibratedModel, companions: Mapping[str, bytes] | None = None) -> str:
    """Write a model directory; replace an existing model atomically, so that a reader sees the old or the new one.

    The new files are loaded by a child process, written to a temporary directory next to the target, flushed to disk,
    and renamed.

    Args:
        directory: target; missing parents are created.
        model: the model to write.
        companions: name -> content of additional files, with names in `COMPANIONS`.

    Returns:
        SHA-256 of the manifest, which identifies the model.

    Raises:
        ModelError: `directory` holds other files, or the model cannot be loaded.
        OSError: the files cannot be written.
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
    """Yield a new directory, which atomically replaces `directory` when the block ends without an error.

    Raises:
        OSError: the files cannot be written; `directory` is unchanged.
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
    """Read a model directory; without a checksum, the model is first loaded by a child process.

    Args:
        directory: of the model.
        manifest_sha256: expected checksum of the manifest, as returned by `write_model` after a child had loaded the
            model; None to accept any model.

    Raises:
        ModelError: not a model, truncated, edited, of a different version, or it crashes the process that loads it.
        CalibrationError: this computer lacks something that loading needs, or its disk fails.
    """
    try:
        return _read_model(directory, manifest_sha256)
    except MemoryError as error:
        raise CalibrationError(f"{directory}: this computer has too little memory to load the model") from error


def _read_model(directory: Path, manifest_sha256: str | None) -> CalibratedModel:
    if not directory.is_dir():
        raise ModelError(f"{directory} is not a directory; name a model directory, as written by `rigcal calibrate`")
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
    """Read a model of a store, for use on a rig.

    Args:
        directory: of the model.
        manifest_sha256: checksum of its manifest in the store.
        rig: the rig that the model is to be used on.

    Raises:
        CalibrationError: as `read_model`.
        UnsafeError: the model was made for a different rig file: names, joints, rows, limits or channels differ.
            Comments and signals may differ.
    """
    model = read_model(directory, manifest_sha256)
    if model.rig.differences(rig):
        raise UnsafeError(
            f"{directory} was made for a rig file (of {model.rig.name!r}) that describes a different machine than the "
            f"one in use (of {rig.name!r}); calibrate with the one in use, or go back to the earlier file"
        )
    return model


def model_sha256(directory: Path) -> str:
    """Return the SHA-256 of the manifest, which identifies the model; ModelError if there is no manifest."""
    data = _read(directory, MANIFEST, _MANIFEST_MAX_BYTES)
    if data is None:
        raise ModelError(f"{directory} is not a model directory: it has no {MANIFEST}")
    return _sha256(data)


def _listed(directory: Path) -> list[str]:
    """Return the file names in the manifest, whose other content is not checked."""
    try:
        names = list(json.loads(_read(directory, MANIFEST, _MANIFEST_MAX_BYTES) or b"")["files"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ModelError(f"{directory}: {MANIFEST} is damaged; restore the model, or remove it") from error
    if len(names) > _FILES_MAX:
        raise ModelError(f"{directory}: {MANIFEST} lists {len(names)} files; a model has at most {_FILES_MAX}")
    for name in names:
        if not (isinstance(name, str) and _FILE_NAME.fullmatch(name)):
            raise ModelError(f"{directory}: {MANIFEST} lists {name!r}, which is not a file name; this is not a model")
    return names


def _read(directory: Path, name: str, most_bytes: int) -> bytes | None:
    """Return the file's bytes; None if there is no file; raise as `read_model` if it is unsuitable or unreadable."""
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
    """Let a new process load the files and predict with them; raise an error if it fails."""
    key = _sha256(files[MANIFEST])
    if key in _checked:
        return
    # -P keeps the current directory off the module search path, so that no file there is imported.
    command = [sys.executable, "-P", "-m", "daemon.models.first_load"]
    try:
        # A new session keeps Ctrl-C from the child, where it would look like a model that crashes its process.
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
        raise ModelError(f"{directory}: the model crashes the process that loads it ({name}); restore it")
    if child.returncode != 0:
        lines = child.stderr.decode("utf-8", "replace").strip().splitlines() or ["no reason given"]
        kind = ModelError if child.returncode == IS_NO_MODEL else CalibrationError
        raise kind(f"{directory}: {lines[-1]}")
    _checked.add(key)


def _put_in_place(new: Path, target: Path) -> None:
    """Rename `new` to `target`; the old target moves into the parent of `new`, or is gone if it was empty."""
    try:
        new.rename(target)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        if not _exchange(new, target):
            # The file system cannot exchange (NFS, some FUSE): for an instant a reader may find no directory.
            target.rename(new.with_name("old"))
            new.rename(target)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two directories atomically (Linux, renameat2(2)); return False if the file system cannot."""
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
