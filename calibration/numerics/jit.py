"""Compilation of numerical loops by numba, without the interpreter's lock, and cached on disk where possible.

numba recompiles a function when its own file changes, but not when a different file changes whose functions or
constants were compiled into it. An installation renews all files. Developers need a separate cache for each state of
the sources, as the Makefile provides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])

_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}  # not nnan, so that overflows remain visible


def compiled(function: _F) -> _F:
    """Compile a function on its first call; cache it on disk if numba finds a writable place, else in memory.

    Args:
        function: loops over arrays, in the subset of Python that numba supports.
    """
    try:
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy", cache=True)(function))
    except RuntimeError:  # numba: no locator available
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy")(function))


def part(*fastmath: str) -> Callable[[_F], _F]:
    """Return a decorator for parts of compiled functions, which have no wrappers for calls from Python.

    Args:
        fastmath: LLVM's fast-math flags, in place of the default ones.
    """
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(
        "Callable[[_F], _F]",
        numba.njit(nogil=True, fastmath=set(fastmath) or _FASTMATH, error_model="numpy", **options),
    )


def inlined(function: _F) -> _F:
    """Compile a function inline into each of the compiled loops that call it.

    Calls with a dozen array arguments would cost a fifth of the time of a walk over a chain.

    Args:
        function: a step of compiled loops, not called from Python.
    """
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "inline": "always"}
    return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy", **options)(function))
