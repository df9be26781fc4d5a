"""Safe reading of arrays from a stored model of unknown origin, and checks of their values.

`numpy.load` trusts the shape of an array and the size of a compressed member, so that two megabytes may become
gigabytes. Archives of `numpy.savez` are not compressed. Therefore only uncompressed archives are read, and no array can
be larger than its archive. Checks of the values ensure finite predictions; a manifest only proves that files have not
changed since they were written.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from calibration.errors import ModelError
from calibration.observations import Floats

LARGEST = 1e9  # limit for lengths, angles and coefficients, in their units; squares of larger ones overflow in sums
_ROTATION_TOLERANCE = 1e-6
_CORRELATION_TOLERANCE = 1e-6  # for rounding in a covariance, relative to its variances
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_ENDING = ".npy"
# Errors, in addition to ValueError, that the standard library and numpy raise for hostile archives and headers.
_DAMAGED = (
    *(EOFError, IndexError, KeyError, OSError, OverflowError, RuntimeError, SyntaxError, TypeError),
    *(struct.error, tokenize.TokenError, zipfile.BadZipFile),
)


def write_npz(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Pack arrays by name, uncompressed and without pickled objects."""
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **arrays)
    return out.getvalue()


def read_npz(data: bytes) -> dict[str, NDArray[np.generic]]:
    """Read the arrays of an archive, by name.

    Args:
        data: bytes that `numpy.savez` wrote.

    Raises:
        ValueError: the data are not such an archive, or it has compressed members or pickled objects.
        MemoryError: this computer has too little memory.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _arrays(archive, len(data))
    except _DAMAGED as error:
        raise ValueError(f"an archive of arrays is damaged: {error}") from error


def _arrays(archive: zipfile.ZipFile, most_bytes: int) -> dict[str, NDArray[np.generic]]:
    members = archive.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("an archive of arrays is compressed, but archives of a model never are")
    if sum(member.file_size for member in members) > most_bytes:
        raise ValueError("an archive declares more data than its own size")
    return {member.filename.removesuffix(_ENDING): _array(archive.read(member), member.filename) for member in members}


def _array(data: bytes, name: str) -> NDArray[np.generic]:
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"{name} has the unsupported format version {version}")
    try:
        shape, is_fortran, dtype = _HEADERS[version](stream)
    except MemoryError as error:  # Python's parser: the header, which is short, is nested too deeply
        raise ValueError(f"the header of {name} is nested too deeply") from error
    body = data[stream.tell() :]
    if dtype.hasobject or dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize != len(body):
        raise ValueError(f"{name} does not hold an array of {dtype} of shape {shape}")
    # A copy, because an array over bytes is read-only
    flat = np.frombuffer(body, dtype).copy()
    return flat.reshape(shape[::-1]).T if is_fortran else flat.reshape(shape)


def float_array(stored: Mapping[str, Any], name: str) -> Floats:
    """Return one of the stored arrays.

    Raises:
        KeyError: there is no array of that name.
        ValueError: its type is not float64.
    """
    array = np.asarray(stored[name])
    if array.dtype != np.float64:
        raise ValueError(f"{name} is an array of {array.dtype}, not of float64")
    return np.ascontiguousarray(array)


def check_rotation(setup: str, rotation: Floats) -> None:
    """Raise ModelError unless the matrix (3, 3) of a set-up's base is a rotation, without scale or reflection."""
    if not (
        np.abs(rotation @ rotation.T - np.eye(3)).max() <= _ROTATION_TOLERANCE and float(np.linalg.det(rotation)) > 0.0
    ):
        raise ModelError(f"the base of set-up {setup!r} is not a rotation; calibrate again")


def check_covariance(covariance: Floats, size: int, of: str) -> None:
    """Raise ModelError unless a matrix is a covariance of `size` numbers: symmetric, positive semidefinite, finite.

    Args:
        covariance: any matrix.
        size: expected number of rows and columns.
        of: name of the numbers, for the message.
    """
    if covariance.shape != (size, size) or not (np.abs(covariance) <= LARGEST**2).all():
        raise ModelError(f"covariance.npz does not match the {of} of model.json; calibrate again")
    # Variances in mm and in rad differ by ten orders of magnitude; only correlations have one scale.
    variance = np.diag(covariance)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    with np.errstate(over="ignore"):  # infinite correlations are refused below
        correlation = covariance / scale / scale[:, None]
    if (
        (variance < 0.0).any()
        or not (np.abs(correlation) <= 1.0 + _CORRELATION_TOLERANCE).all()
        or np.abs(correlation - correlation.T).max(initial=0.0) > _CORRELATION_TOLERANCE
        or np.linalg.eigvalsh(correlation).min(initial=0.0) < -_CORRELATION_TOLERANCE
    ):
        raise ModelError(
            f"covariance.npz does not hold a covariance of the {of} of model.json (it is not symmetric and positive "
            "semidefinite); calibrate again"
        )


def check_names(found: Iterable[str], known: tuple[str, ...], what: str) -> None:
    """Raise ModelError if one of the names found is unknown to the rig.

    Args:
        found: names in the model.
        known: names in the rig file.
        what: kind of these names, for the message.
    """
    strange = [name for name in found if name not in known]
    if strange:
        raise ModelError(f"model.json has {what} {strange[0]!r}, which its rig lacks; calibrate again")
