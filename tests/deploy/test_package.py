"""What goes into the Debian packages; `make debtest` tries whole ones in fresh Debian roots."""

import shutil
from pathlib import Path

import pytest

from deploy.release import debian
from tests.deploy.conftest import DEPLOY, REPOSITORY, run


def test_every_file_of_the_service_is_packed() -> None:
    ours = {path.name for path in DEPLOY.iterdir() if path.is_file()} - {"bootstrap.sh", "install.sh", "__init__.py"}
    assert ours <= set(debian.FILES)


@pytest.mark.parametrize(("python", "numpy"), [("3.11", "numpy==2.4."), ("3.13", "numpy==2.5.")])
def test_each_package_is_locked_for_its_own_python(python: str, numpy: str) -> None:
    locked = debian.locked_for(REPOSITORY / "requirements.lock", python)
    lines = [line for line in locked.splitlines() if line[:1].isalpha()]
    (found,) = (line for line in lines if line.startswith("numpy=="))
    assert found.startswith(numpy)
    assert ";" not in locked
    assert not any(line.startswith(("pip==", "setuptools==")) for line in lines)
    assert locked.count("--hash=sha256:") >= len(lines)


@pytest.mark.parametrize("name", ["preinst", "postinst", "prerm", "postrm"])
def test_the_scripts_of_a_package_are_sound_shell(name: str) -> None:
    script = DEPLOY / "debian" / name
    assert run("sh", "-n", script).returncode == 0
    assert script.read_text(encoding="utf-8").startswith("#!/bin/sh\n")


@pytest.mark.skipif(shutil.which("dpkg") is None, reason="versions are compared by dpkg")
def test_a_downgrade_is_refused_before_anything_changes(tmp_path: Path) -> None:
    script = tmp_path / "preinst"
    text = (DEPLOY / "debian" / "preinst").read_text(encoding="utf-8").replace("@VERSION@", "0.2.0~deb12")
    script.write_text(text, encoding="utf-8")
    refused = run("sh", script, "upgrade", "0.3.0~deb12")
    assert refused.returncode == 1
    assert "it could not open the store" in refused.stdout
    assert run("sh", script, "upgrade", "0.1.0~deb12", RIGCAL_UPGRADE_WITHOUT_BACKUP="yes").returncode == 0
