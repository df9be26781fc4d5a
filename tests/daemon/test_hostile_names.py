"""Names that try something, from clients, stores, instruments and files: shown as they are spelled, or refused."""

import contextlib
import logging
import os
import pty
import re
import shutil
import sqlite3
import subprocess
import sys
import unicodedata
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from daemon.cli.main import main
from daemon.cli.terminal import echo, echo_list, echo_table
from daemon.commands import CommandError
from daemon.config.config import Config
from daemon.control.protocol import request
from daemon.host.safe_output import shown
from daemon.host.systemd import Notifier
from daemon.report.calibration.inputs import ControlPoint, ParameterLine, SetupLine
from daemon.report.calibration.page import calibration_report
from daemon.service import declare_channels
from daemon.store.store import Store
from drivers.clock import ManualClock
from drivers.readings import DecodeFailure, DeviceEvent, EventKind, Fix, LockState, Status
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.support.jobs import SOURCE
from tests.daemon.support.report_inputs import report_input

CONFIG = """
rig = "{rig}"

[[can]]
name = "boom"
interface = "socketcan"
channel = "can0"
"""
CLI = Path(main.callback.__code__.co_filename).parent if main.callback is not None else Path()
# Printable: taken as they are, and shown so.
MARKUP = {
    "tag": "[red]x[/red]",
    "closing tag": "[/x]",
    "link": "[link=http://e.org]x[/link]",
    "emoji": "a:skull:b",
    "formula": r"$\frac{$",
    "html": "<script>alert(1)</script>",
    "quotes": "\"'&amp;",
}
# Not printable: refused from clients; escaped wherever else they come from.
CONTROL = {
    "erases the screen": "a\x1b[2Jb",
    "sets the title": "a\x1b]0;owned\x07b",
    "turns red": "a\x1b[31mb",
    "begins a line": "a\nmodel 9 is live",
    "goes back": "a\rb\x08c",
    "C1": "a\x9b2Jb",
    "reads backwards": "a\u202egpj.exe",
    "separates lines": "a\u2028b",
    "is invisible": "a\u200b\u2066b",
}
ANY = MARKUP | CONTROL
MIXED = "".join(ANY.values())
_STYLES = re.compile(r"\x1b\[[0-9;]*m")


def assert_plain(text: str) -> None:
    """Nothing of a text can do anything to a terminal."""
    bad = [c for c in text if c != "\n" and unicodedata.category(c) in {"Cc", "Cf", "Cs", "Zl", "Zp"}]
    assert not bad, (bad, text)


def on_terminal(*arguments: str) -> str:
    """What a command writes to a terminal of 400 columns, without the colours of styles."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "daemon.cli.main", *arguments]
    environ = os.environ | {"COLUMNS": "400", "TERM": "xterm-256color"}
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environ) as process:
        os.close(theirs)
        text = b""
        with contextlib.suppress(OSError):  # EIO: its end
            while data := os.read(ours, 65536):
                text += data
        os.close(ours)
    said = text.decode("utf-8").replace("\r\n", "\n")
    assert process.returncode == 0, said
    return _STYLES.sub("", said)


# ---- from clients ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Config]:
    with idle_daemon(tmp_path_factory.mktemp("rig")) as config:
        request(config.socket_path, "setup.new", {"id": "S0"})
        yield config


def says(config: Config, command: str, **arguments: Any) -> Callable[[str], Any]:
    """A function that gives a command in which each value None is a hostile name."""
    return lambda name: request(
        config.socket_path, command, {key: name if value is None else value for key, value in arguments.items()}
    )


TEXTS = {
    "instrument": ("setup.new", {"id": "S1", "instrument": None}),
    "serial": ("setup.new", {"id": "S1", "serial": None}),
    "set-up's note": ("setup.new", {"id": "S1", "note": None}),
    "operator": ("session.start", {"prism": "r", "operator": None}),
    "session's note": ("session.start", {"prism": "r", "note": None}),
    "who accepts": ("session.accept", {"id": "s", "operator": None}),
    "reason of a rejection": ("session.reject", {"id": "s", "reason": None}),
}
NAMES = {
    "set-up": ("setup.new", {"id": None}),
    "prism": ("session.start", {"prism": None}),
    "kind": ("session.start", {"prism": "r", "kind": None}),
    "set-up of a session": ("session.start", {"prism": "r", "setup": None}),
    "session": ("session.start", {"prism": "r", "id": None}),
    "shown session": ("session.show", {"id": None}),
    "accepted session": ("session.accept", {"id": None}),
    "job": ("jobs.cancel", {"id": None}),
    "model": ("model.show", {"id": None}),
    "tip": ("tip", {"prism": None}),
}


@pytest.mark.parametrize("name", [*CONTROL.values(), "x" * 501], ids=[*CONTROL, "without end"])
@pytest.mark.parametrize(("command", "arguments"), [*TEXTS.values(), *NAMES.values()], ids=[*TEXTS, *NAMES])
def test_a_text_that_cannot_be_printed_is_refused(
    daemon: Config, command: str, arguments: dict[str, Any], name: str
) -> None:
    with pytest.raises(CommandError) as refused:
        says(daemon, command, **arguments)(name)
    assert refused.value.status == 2
    assert_plain(str(refused.value))
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize("name", MARKUP.values(), ids=MARKUP.keys())
@pytest.mark.parametrize(("command", "arguments"), NAMES.values(), ids=NAMES.keys())
def test_an_id_is_letters_and_digits(daemon: Config, command: str, arguments: dict[str, Any], name: str) -> None:
    with pytest.raises(CommandError) as refused:
        says(daemon, command, **arguments)(name)
    assert refused.value.status == 2


def test_points_and_prism_constants_are_not_without_end(daemon: Config) -> None:
    for key in ("control_points", "prism_constants_mm"):
        with pytest.raises(CommandError, match=f"{key} must be an object of at most 100 entries"):
            request(daemon.socket_path, "setup.new", {"id": "S1", key: {f"p{n}": [0, 0, 0] for n in range(101)}})
    for name in ANY.values():
        with pytest.raises(CommandError) as refused:
            request(daemon.socket_path, "setup.new", {"id": "S1", "control_points": {name: [0, 0, 0]}})
        assert_plain(str(refused.value))


def test_texts_with_markup_are_shown_as_they_are_spelled(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        for n, text in enumerate(MARKUP.values()):
            request(config.socket_path, "setup.new", {"id": f"S{n}", "instrument": text})
            request(config.socket_path, "session.start", {"prism": "r", "operator": text})
            request(config.socket_path, "session.stop")
        for listing in ("setup", "session"):
            said = on_terminal(listing, "list", "--socket", str(config.socket_path))
            assert_plain(said)
            for text in MARKUP.values():
                assert text in said


# ---- from a store that already holds them ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Config]:
    """A daemon whose store holds hostile names wherever a text is kept, and one that is no text at all."""
    directory = tmp_path_factory.mktemp("full")
    store = Store(directory / "rigcal.sqlite")
    now = ManualClock().now()
    declare_channels(store, SOURCE.rig)
    for n, name in enumerate(ANY.values()):
        setup = {"id": f"S{n}{name}", "instrument": name, "serial": name, "note": name, "state": "ok"}
        store.insert("station_setups", setup | store.instant(now, "created_"))
        place = {"setup_id": setup["id"], "name": name, "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0}
        store.insert("control_points", place)
        session = {"id": f"s{n}{name}", "rig": "swdt82", "setup_id": setup["id"]}
        session |= {"prism": name, "operator": name, "note": name, "caller_user": name, "kind": "static_poses"}
        state = "open" if n == 0 else "closed"
        store.insert("calibration_sessions", session | {"state": state} | store.instant(now, "started_"))
        shot = {"setup_id": setup["id"], "name": name, "session_id": session["id"], "phase": "start"}
        shot |= {"x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0, "fix_ids_json": []}
        store.insert("control_shots", shot | store.instant(now))
        observed = {"session_id": session["id"], "prism": name, "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0, "moving": 0}
        observed |= {"values_json": {}, "excluded": name}
        store.insert("observations", observed | store.instant(now))
        job = {"kind": "gap", "session_id": session["id"], "through_session_id": session["id"], "state": "failed"}
        made = {"model": name, "sessions": [session["id"]], "manifest_sha256": name}
        row = job | {"message": name, "error": name, "result_json": made} | store.instant(now, "created_")
        job_id = store.insert("jobs", row)
        model = {"rig": "swdt82", "path": name, "manifest_sha256": name, "stage": name, "job_id": job_id}
        compared = {"live": None, "is_better": False, "sessions": [name], "sentence": name}
        model |= {"state": "candidate", "metrics_json": {"comparison": compared}}
        model_id = store.insert("models", model | store.instant(now, "created_"))
        change = {"model_id": model_id, "state": "candidate", "operator": name, "caller_user": name, "reason": name}
        store.insert("model_states", change | store.instant(now))
        device = f"d{n}{name}"
        store.insert_records(
            [
                DeviceEvent(device, now, EventKind.EMERGENCY, name),
                DecodeFailure(device, now, name, name.encode("utf-8", "replace")),
                Fix("station", now, now, Status.MALFORMED, LockState.SEARCHING, reason=name),
            ]
        )
    store.close()
    with contextlib.closing(sqlite3.connect(directory / "rigcal.sqlite")) as other, other:
        other.execute("UPDATE station_setups SET serial = CAST(x'ff1b5b324a' AS TEXT), note = CAST(x'80' AS TEXT)")
    with idle_daemon(directory) as config:
        yield config


@pytest.mark.parametrize(
    "command",
    [
        ("setup", "list"),
        ("session", "list"),
        ("jobs", "list"),
        ("model", "list"),
        ("status",),
        ("status", "--frames"),
        ("alarms", "--all"),
    ],
    ids=" ".join,
)
def test_one_bad_name_in_the_store_spoils_no_list(full: Config, command: tuple[str, ...]) -> None:
    said = on_terminal(*command, "--socket", str(full.socket_path))
    assert_plain(said)
    if "list" in command:
        for name in ANY.values():
            assert shown(name) in said


def test_one_bad_name_moves_nothing_on_the_live_screen(full: Config) -> None:
    said = on_terminal("watch", "--count", "1", "--socket", str(full.socket_path))
    for own in ("\x1b[?1049h\x1b[?25l", "\x1b[H", "\x1b[K\r\n", "\x1b[J", "\x1b[?25h\x1b[?1049l"):
        said = said.replace(own, "")
    assert_plain(re.sub(r"\x1b\[\d*m", "", said))  # colours are the screen's own, and names have lost their escapes
    assert "rig       swdt82" in said


@pytest.mark.parametrize("number", range(len(ANY)), ids=ANY.keys())
def test_one_bad_name_spoils_no_session_and_no_model(full: Config, number: int) -> None:
    runner = CliRunner(env={"COLUMNS": "400"})
    name = [*ANY.values()][number]
    for command, wanted in (("session", f"s{number}{name}"), ("model", str(number + 1))):
        said = runner.invoke(main, [command, "show", wanted, "--socket", str(full.socket_path)])
        assert said.exit_code == 0, said.output
        assert_plain(said.stdout)
        assert shown(name) in said.stdout
        as_json = runner.invoke(main, [command, "show", wanted, "--socket", str(full.socket_path), "--json"])
        assert as_json.exit_code == 0, as_json.output
        assert_plain(as_json.stdout)


# ---- from files and the command line ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ANY.values(), ids=ANY.keys())
def test_names_in_files_reach_errors_as_plain_text(tmp_path: Path, name: str) -> None:
    file = name.replace("/", "|")
    table = tmp_path / f"{file}.csv"
    table.write_text(f'prism,x_mm,"{name}"\n"{name}",1,2\n', encoding="utf-8")
    rig = tmp_path / f"{file}.toml"
    rig.write_text(f"rig = {name!r}\n{name!r} = 3\n", encoding="utf-8")
    for command in (
        ("calibrate", "--rig", "swdt82", "--data", str(table), "--out", str(tmp_path / "out")),
        ("calibrate", "--rig", str(rig), "--data", str(table), "--out", str(tmp_path / "out")),
        ("config", "check", str(rig)),
        ("config", "check", str(tmp_path / f"none{file}")),
        ("session", "show", name, "--socket", str(tmp_path / f"none{file}")),
        ("session", "show", "s", name),
        ("session", "show", f"--{name}"),
        ("calibrate", "--rig", "swdt82", "--data", str(tmp_path / f"none{file}"), "--out", "out"),
    ):
        said = CliRunner().invoke(main, command)
        assert said.exit_code in {1, 2}, said.output
        assert_plain(said.output)


def test_a_library_that_warns_of_a_name_in_a_file_writes_plain_text(tmp_path: Path) -> None:
    rigs = Path(str(resources.files("calibration").joinpath("rigs")))
    shutil.copytree(rigs, tmp_path, dirs_exist_ok=True)
    name = "".join(name for name in ANY.values() if name.splitlines() == [name])
    unknown = f"\n[2000]\nParameterName={name}\nObjectType=0x7\nDataType=0x99\nAccessType=ro\n"
    eds = (rigs / "cia406.eds").read_text(encoding="latin-1") + unknown
    (tmp_path / "encoder.eds").write_text(eds, encoding="utf-8")
    rig = (rigs / "swdt82.toml").read_text(encoding="utf-8")
    (tmp_path / "rig.toml").write_text(rig.replace("node = 32\n", 'node = 32\neds = "encoder.eds"\n'), encoding="utf-8")
    config = tmp_path / "rigcal.toml"
    config.write_text(CONFIG.format(rig=tmp_path / "rig.toml"), encoding="utf-8")
    command = [sys.executable, "-m", "daemon.cli.main", "config", "check", str(config)]
    done = subprocess.run(command, capture_output=True, check=False, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert "unsupported data type" in done.stderr
    assert_plain(done.stderr)


def test_file_names_that_are_no_unicode_are_named_all_the_same(tmp_path: Path) -> None:
    missing = os.fsdecode(os.fsencode(tmp_path) + b"/\xff\x1b[2J")
    command = [sys.executable, "-m", "daemon.cli.main", "config", "check", missing]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == 2
    assert rb"\udcff\x1b[2J: cannot be read" in done.stderr


# ---- ways out --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*ANY.values(), "\ud800"], ids=[*ANY, "half a character"])
def test_what_is_shown_is_plain_and_says_what_was_there(name: str) -> None:
    assert_plain(shown(name))
    assert shown(shown(name)) == shown(name)
    assert name.isprintable() == (shown(name) == name)


def test_words_of_other_scripts_are_shown_as_they_are() -> None:
    for word in ("Bjørn Ødegård", "钻机", "буровая", "حفارة", "5\N{NO-BREAK SPACE}mm", "e\N{COMBINING ACUTE ACCENT}"):
        assert shown(word) == word


def test_a_text_without_end_is_cut_off() -> None:
    assert len(shown("x" * 1_000_000)) < 5000


def test_every_line_for_people_is_escaped() -> None:
    """Lines and tables are printed by `terminal` alone; a result by `command`, `offline` and `tip`."""
    for path in CLI.rglob("*.py"):
        if path.name not in {"terminal.py", "command.py", "offline.py", "tip.py"}:
            source = path.read_text(encoding="utf-8")
            assert not re.search(r"click\.s?echo\(|(?<!\w)print\(", source), f"{path}: use daemon.cli.terminal.echo"


def test_the_service_manager_is_told_one_state_a_line(tmp_path: Path) -> None:
    import socket

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).send("READY=1", "STATUS=rig a\nMAINPID=1")
        assert manager.recv(1000) == b"READY=1\nSTATUS=rig a\\nMAINPID=1"


def test_titles_and_cells_of_tables_are_plain_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "1000")  # else a long cell is wrapped
    echo_table((MIXED,), [(MIXED,)], title=MIXED)
    echo_list("title", [MIXED])
    echo(MIXED, bold=True)
    said = capsys.readouterr().out
    assert_plain(said)
    assert said.count(shown(MIXED)) == 5


def test_names_in_a_report_are_neither_markup_nor_formulas(caplog: pytest.LogCaptureFixture) -> None:
    report = report_input(
        n=4,
        held_out=False,
        rig=MIXED,
        warnings=[MIXED],
        ignored_columns=[MIXED],
        parameters=[ParameterLine(MIXED, MIXED, 0.9, 0.02, 0.2, True)],
        setups=[SetupLine(MIXED, MIXED, True, [ControlPoint(MIXED, (0.3, -0.4, 0.0), None)])],
        provenance={"made": MIXED, MIXED: MIXED},
    )
    with caplog.at_level(logging.WARNING):
        document = calibration_report(report)
    assert_plain(document)
    assert "<script" not in document
    assert r"$\frac{$" in document
