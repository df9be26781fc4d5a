"""A writable place for what numba compiles and matplotlib indexes, chosen before either is imported.

Both keep files between runs: by default beside the installed program or in the home directory. A service has neither
to write to, and a laptop's may be read-only; then numba refuses to compile at all.
"""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator, MutableMapping
from pathlib import Path


def prepare(environ: MutableMapping[str, str] = os.environ) -> Path:
    """Point NUMBA_CACHE_DIR and MPLCONFIGDIR at writable directories; call before numba or matplotlib is imported.

    A directory the user has set is kept where it can be written. Otherwise the service's CACHE_DIRECTORY (systemd),
    the user's cache directory and a private temporary directory are tried in this order.

    Args:
        environ: the process's environment, which spawned children inherit.

    Returns:
        The directory of numba's cache.

    Raises:
        OSError: not even a temporary directory can be made.
    """
    root: Path | None = None
    for variable, name in (("NUMBA_CACHE_DIR", "numba"), ("MPLCONFIGDIR", "matplotlib")):
        if environ.get(variable) and _writable(Path(environ[variable])):
            continue
        if root is None:
            root = next((path for path in _candidates(environ) if _writable(path)), None) or _private_temporary()
        path = root / name
        path.mkdir(exist_ok=True)
        environ[variable] = str(path)
    return Path(environ["NUMBA_CACHE_DIR"])


def is_compiled(environ: MutableMapping[str, str] = os.environ) -> bool:
    """Whether anything was compiled before into the directory that `prepare` chooses."""
    return any(prepare(environ).rglob("*.nbi"))


def _candidates(environ: MutableMapping[str, str]) -> Iterator[Path]:
    if service := environ.get("CACHE_DIRECTORY"):
        yield Path(service.split(":")[0])
    if cache := environ.get("XDG_CACHE_HOME"):
        yield Path(cache) / "rigcal"
    if home := environ.get("HOME"):
        yield Path(home) / ".cache" / "rigcal"


def _writable(path: Path) -> bool:
    # Permission bits say nothing of read-only mounts, so a file is made.
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def _private_temporary() -> Path:
    # The caches hold code that is run: a directory that another user could have prepared is not used.
    path = Path(tempfile.gettempdir()) / f"rigcal-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = path.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
        return path
    return Path(tempfile.mkdtemp(prefix="rigcal-"))
