"""The unit of the operator's page: systemd takes it, it is exposed little, and its user can read what it needs."""

import grp
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.control.protocol import request
from tests.daemon.support.idle_daemon import idle_daemon
from tests.deploy.conftest import DEPLOY, program, run
from tests.deploy.test_service import settings

UNIT = DEPLOY / "rigcal-web.service"
READ_AS_STRANGER = """
import os, sys
from pathlib import Path
from daemon.store.reader import Reader
from daemon.web.settings import WebSettings
os.setgroups([])
os.setgid(int(sys.argv[1]))
os.setuid(65534)
with Reader(Path(sys.argv[2])) as reader:
    print([row["id"] for row in reader.rows("SELECT id FROM station_setups")])
try:
    open(sys.argv[2], "r+")
except PermissionError:
    print("not written")
print(WebSettings(Path(sys.argv[3]), Path("tokens")).role_without_token().word)
"""


def test_systemd_has_nothing_to_say_about_the_unit(installed: Path) -> None:
    system_units = next(p for p in (Path("/usr/lib/systemd/system"), Path("/lib/systemd/system")) if p.exists())
    shutil.copytree(system_units, installed / "usr/lib/systemd/system", symlinks=True)
    executable = installed / "opt/rigcal/venv/bin/rigcal"
    executable.parent.mkdir(parents=True)
    executable.write_text("#!/bin/sh\n", encoding="utf-8")
    executable.chmod(0o755)
    analyze = program("systemd-analyze", "systemd")
    result = run(analyze, "verify", "--man=no", f"--root={installed}", "rigcal-web.service")
    assert (result.stdout, result.returncode) == ("", 0)


def test_the_page_is_exposed_little() -> None:
    analyze = program("systemd-analyze", "systemd")
    result = run(analyze, "security", "--no-pager", "--offline=true", "--threshold=15", UNIT)
    assert result.returncode == 0, result.stdout


def test_the_page_has_a_user_of_its_own_that_writes_nothing_of_the_daemons() -> None:
    unit = settings(UNIT)
    assert (unit["User"], unit["Group"]) == (["rigcal-web"], ["rigcal"])
    assert "StateDirectory" not in unit
    assert "--loopback-role read" in unit["ExecStart"][0]
    assert "m rigcal-web rigcal" in (DEPLOY / "rigcal.sysusers").read_text(encoding="utf-8")


@pytest.fixture
def reachable() -> Iterator[Path]:
    """A directory that members of the group may enter, as the service's state directory is."""
    directory = Path(tempfile.mkdtemp(prefix="rigcal-"))
    directory.chmod(0o750)
    yield directory
    shutil.rmtree(directory)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root becomes another user")
def test_a_member_of_the_group_reads_the_store_of_a_running_daemon_and_may_ask_it(reachable: Path) -> None:
    before = os.umask(0o027)
    try:
        with idle_daemon(reachable) as config:
            request(config.socket_path, "setup.new", {"id": "S1"})
            group = str(grp.getgrgid(os.getegid()).gr_gid)
            arguments = (READ_AS_STRANGER, group, str(config.store_path), str(config.socket_path))
            found = subprocess.run(
                [sys.executable, "-c", *arguments], capture_output=True, text=True, check=False, cwd=Path.cwd()
            )
    finally:
        os.umask(before)
    assert found.stdout.splitlines() == ["['S1']", "not written", "approve"], found.stderr
