"""Arrays from an npz archive that someone else may have made: never larger in memory than the archive itself.

`numpy.load` takes an array's shape and a compressed member's size on trust: two megabytes become gigabytes. What
`numpy.savez` writes is not compressed, so nothing else is read.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_ENDING = ".npy"
# What the standard library and numpy end with on hostile archives and headers, beside ValueError
_DAMAGED = (
    *(EOFError, IndexError, KeyError, MemoryError, OSError, OverflowError, RuntimeError, SyntaxError, TypeError),
    *(struct.error, tokenize.TokenError, zipfile.BadZipFile),
)


def read_npz(data: bytes) -> dict[str, NDArray[np.generic]]:
    """The arrays by name.

    Args:
        data: what `numpy.savez` wrote.

    Raises:
        ValueError: no such archive, or one with compressed members or pickled objects.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _arrays(archive, len(data))
    except _DAMAGED as error:
        raise ValueError(f"an archive of arrays is damaged: {error}") from error


def _arrays(archive: zipfile.ZipFile, most_bytes: int) -> dict[str, NDArray[np.generic]]:
    members = archive.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("an archive of arrays is compressed, which those of a model never are")
    if sum(member.file_size for member in members) > most_bytes:
        raise ValueError("an archive holds more than its own size")
    return {member.filename.removesuffix(_ENDING): _array(archive.read(member), member.filename) for member in members}


def _array(data: bytes, name: str) -> NDArray[np.generic]:
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"{name} has version {version} of its format")
    shape, is_fortran, dtype = _HEADERS[version](stream)
    body = data[stream.tell() :]
    if dtype.hasobject or dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize != len(body):
        raise ValueError(f"{name} does not hold an array of {dtype} of shape {shape}")
    # A copy, because an array over bytes cannot be written to
    flat = np.frombuffer(body, dtype).copy()
    return flat.reshape(shape[::-1]).T if is_fortran else flat.reshape(shape)
