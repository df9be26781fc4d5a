from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from daemon.warm_up import is_compiled, prepare


def test_a_directory_the_user_set_is_kept(tmp_path: Path) -> None:
    environ = {"NUMBA_CACHE_DIR": str(tmp_path / "own"), "HOME": str(tmp_path)}
    assert prepare(environ) == tmp_path / "own"
    assert environ["MPLCONFIGDIR"] == str(tmp_path / ".cache" / "rigcal" / "matplotlib")


def test_a_service_uses_its_cache_directory(tmp_path: Path) -> None:
    environ = {"CACHE_DIRECTORY": str(tmp_path / "service"), "HOME": str(tmp_path / "home")}
    assert prepare(environ) == tmp_path / "service" / "numba"
    assert (tmp_path / "service" / "matplotlib").is_dir()


def test_an_unusable_directory_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a directory")
    environ = {"NUMBA_CACHE_DIR": str(tmp_path / "file" / "cache"), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    assert prepare(environ) == tmp_path / "cache" / "rigcal" / "numba"
    assert environ["NUMBA_CACHE_DIR"] == str(tmp_path / "cache" / "rigcal" / "numba")


def test_without_a_home_a_private_temporary_directory_serves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = prepare({})
    assert path.parent.parent == tmp_path
    assert path.parent.stat().st_mode & 0o777 == 0o700


def test_a_temporary_directory_that_others_can_write_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = prepare({}).parent
    first.chmod(0o777)
    assert prepare({}).parent != first


def test_what_was_compiled_before_is_found(tmp_path: Path) -> None:
    environ = {"XDG_CACHE_HOME": str(tmp_path)}
    assert not is_compiled(environ)
    place = tmp_path / "rigcal" / "numba" / "kernels_1"
    place.mkdir(parents=True)
    (place / "loops.nbi").write_bytes(b"")
    assert is_compiled(environ)
