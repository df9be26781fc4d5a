"""Installing the service's files, and installing them again over a site's own."""

import os
import shutil
from pathlib import Path

import pytest

from tests.deploy.conftest import DEPLOY, private_namespaces, run


def test_a_second_installation_keeps_what_the_site_edited(installed: Path) -> None:
    edited = [
        installed / "etc/rigcal/rigcal.toml",
        installed / "etc/udev/rules.d/99-rigcal-station.rules",
        installed / "etc/systemd/network/80-can0.network",
    ]
    for file in edited:
        file.write_text("# the site's own\n", encoding="utf-8")
    result = run(DEPLOY / "install.sh", DESTDIR=str(installed))
    assert result.returncode == 0, result.stdout
    for file in edited:
        assert file.read_text(encoding="utf-8") == "# the site's own\n"
        assert f"kept {file}" in result.stdout


def test_a_second_installation_renews_what_belongs_to_rigcal(installed: Path) -> None:
    unit = installed / "etc/systemd/system/rigcal.service"
    unit.write_text("old", encoding="utf-8")
    assert run(DEPLOY / "install.sh", DESTDIR=str(installed)).returncode == 0
    assert unit.read_bytes() == (DEPLOY / "rigcal.service").read_bytes()


def test_every_file_of_the_service_is_installed(installed: Path) -> None:
    ours = {path.name for path in DEPLOY.iterdir() if path.is_file()} - {
        "README.md",
        "__init__.py",
        "bootstrap.sh",
        "install.sh",
    }
    assert len([path for path in installed.rglob("*") if path.is_file()]) == len(ours)


def test_without_root_the_installation_says_so_and_changes_nothing(tmp_path: Path) -> None:
    # Whoever runs the tests: `id -u` answers as a user's would.
    (tmp_path / "id").write_text("#!/bin/sh\necho 1000\n", encoding="utf-8")
    (tmp_path / "id").chmod(0o755)
    result = run(DEPLOY / "install.sh", DESTDIR="", PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert result.returncode == 1
    assert result.stdout == ("rigcal installation: this changes /opt, /etc and the list of users; run it as root\n")


@pytest.mark.parametrize("signal", ["HUP", "INT", "TERM"])
def test_an_upgrade_that_is_cut_off_starts_the_service_again(tmp_path: Path, signal: str) -> None:
    deploy, asked = tmp_path / "deploy", tmp_path / "asked"
    shutil.copytree(DEPLOY, deploy)
    for script, line in (
        (deploy / "bootstrap.sh", f"kill -{signal} $PPID"),
        (tmp_path / "systemctl", f'echo "$@" >>{asked}'),
    ):
        script.write_text(f"#!/bin/sh\n{line}\n", encoding="utf-8")
        script.chmod(0o755)
    booted = f"mount -t tmpfs none /run; mkdir -p /run/systemd/system; exec {deploy}/install.sh"
    result = run(*private_namespaces(), booted, DESTDIR="", PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert result.returncode == 1, result.stdout
    assert asked.read_text(encoding="utf-8").splitlines() == [
        "--quiet is-active rigcal.service",
        "stop rigcal.service",
        "start rigcal.service",
    ]


@pytest.mark.parametrize("script", ["bootstrap.sh", "install.sh"])
def test_the_scripts_keep_to_the_posix_shell(script: str) -> None:
    result = run("sh", "-n", DEPLOY / script)
    assert (result.returncode, result.stdout) == (0, "")
    assert (DEPLOY / script).read_text(encoding="utf-8").startswith("#!/bin/sh\n")


def test_kernels_are_compiled_ahead_as_the_service_would_and_where_it_looks(installed: Path) -> None:
    script = (DEPLOY / "install.sh").read_text(encoding="utf-8")
    unit = (installed / "etc/systemd/system/rigcal.service").read_text(encoding="utf-8").splitlines()
    (line,) = [line for line in script.splitlines() if "daemon.warm_up" in line]
    user, cache = line.split("runuser -u ")[1].split()[0], line.split("CACHE_DIRECTORY=")[1].split()[0]
    python = line.split("daemon.warm_up")[0].split()[-3]
    assert f"User={user}" in unit
    assert f"CacheDirectory={cache.removeprefix('/var/cache/')}" in unit
    assert any(setting.startswith(f"ExecStart={Path(python).parent}/rigcal ") for setting in unit)
