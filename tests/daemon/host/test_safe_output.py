"""Files are written whole or not at all, and an error names the file."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from daemon.host.safe_output import write_file


def test_an_error_names_the_file_that_could_not_be_written(tmp_path: Path) -> None:
    """The limit on a file's size stands for a full disk, which reports a failed write without a name, too."""
    path = tmp_path / "rigcal.toml"
    path.write_bytes(b"before")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4, hard))
    try:
        with pytest.raises(OSError, match=r"rigcal\.toml") as caught:
            write_file(path, b"longer than that")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
