"""Compilation of numerical loops by numba, without the interpreter's lock, and kept on disk where possible.

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
    """Compile a function on its first call; keep it on disk if numba finds a writable place, else in memory.

    Args:
        function: loops over arrays, in the part of Python that numba compiles.
    """
    try:
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy", cache=True)(function))
    except RuntimeError:  # numba: no locator available
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy")(function))


def part(*fastmath: str) -> Callable[[_F], _F]:
    """Return a decorator for parts of compiled functions: without the wrappers that Python would call them by.

    Args:
        fastmath: LLVM's flags for its arithmetic, in place of the usual ones.
    """
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(
        "Callable[[_F], _F]",
        numba.njit(nogil=True, fastmath=set(fastmath) or _FASTMATH, error_model="numpy", **options),
    )


def inlined(function: _F) -> _F:
    """Compile a step into each of the compiled loops that call it.

    The calls of a walk over a chain, with the dozen arrays that each is handed, cost a fifth of its time.

    Args:
        function: a step of compiled loops; Python does not call it.
    """
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "inline": "always"}
    return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy", **options)(function))
