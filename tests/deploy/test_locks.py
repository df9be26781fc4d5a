"""The lock files: complete, hashed, of one mind, and free of the machine that wrote them."""

import re
import tomllib

import pytest

from tests.deploy.conftest import REPOSITORY

LOCKS = ["requirements.lock", "requirements-dev.lock"]


def entries(lock: str) -> dict[str, list[tuple[str, int]]]:
    """Package name -> its pins (version with marker, number of hashes); several where Python versions differ."""
    found: dict[str, list[tuple[str, int]]] = {}
    for block in re.split(r"(?m)^(?=[A-Za-z0-9])", (REPOSITORY / lock).read_text(encoding="utf-8"))[1:]:
        pin = re.match(r"([a-z0-9-]+)==([^\\\n]+)", block)
        assert pin is not None, f"{lock}: not a pinned package: {block.splitlines()[0]}"
        found.setdefault(pin[1], []).append((pin[2].strip(), block.count("--hash=sha256:")))
    return found


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[^A-Za-z0-9._-]", one)[0].lower().replace("_", "-") for one in requirements}


def project() -> dict[str, object]:
    loaded: dict[str, object] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return loaded


@pytest.mark.parametrize("lock", LOCKS)
def test_every_locked_package_has_hashes(lock: str) -> None:
    assert [name for name, pins in entries(lock).items() if not all(hashes for _, hashes in pins)] == []


@pytest.mark.parametrize("lock", LOCKS)
def test_no_lock_names_a_path_or_an_index(lock: str) -> None:
    text = (REPOSITORY / lock).read_text(encoding="utf-8")
    assert re.findall(r"https?:|file:|--(?:extra-)?index|--find-links|(?m:^\s*#.*\s/)", text) == []


def test_the_rig_gets_every_dependency_and_the_build_backend_and_no_tools() -> None:
    dependencies = project()["dependencies"]
    assert isinstance(dependencies, list)
    locked = entries("requirements.lock").keys()
    assert names(dependencies) | {"setuptools"} <= locked
    assert locked.isdisjoint({"pytest", "mypy", "ruff", "uv", "distributed"})


def test_development_gets_every_tool() -> None:
    extras = project()["optional-dependencies"]
    assert isinstance(extras, dict)
    assert names(extras["dev"] + extras["bench"]) <= entries("requirements-dev.lock").keys()


def test_what_is_tested_is_what_the_rig_gets() -> None:
    developed = entries("requirements-dev.lock")
    for name, pins in entries("requirements.lock").items():
        assert developed[name] == pins
