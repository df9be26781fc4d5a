"""How numerical loops are compiled: without the interpreter's lock, and kept on disk where there is a place.

numba renews what it keeps when the file of the compiled function changes, but not when another file does whose
functions or constants were compiled into it. Installing renews all files; who works on the sources gives each state of
them a cache of its own, as the Makefile does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])

_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}  # not nnan: what overflows must stay visible


def compiled(function: _F) -> _F:
    """Compile on first call, kept on disk where numba finds a writable place, in memory alone where it does not."""
    try:
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy", cache=True)(function))
    except RuntimeError:  # numba: no locator available
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy")(function))


def part(*fastmath: str) -> Callable[[_F], _F]:
    """Compile as a part of compiled functions alone: without the wrappers that Python would call it by.

    Args:
        fastmath: what the compiler may do to its arithmetic, in place of what it may elsewhere.
    """
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(
        "Callable[[_F], _F]",
        numba.njit(nogil=True, fastmath=set(fastmath) or _FASTMATH, error_model="numpy", **options),
    )
