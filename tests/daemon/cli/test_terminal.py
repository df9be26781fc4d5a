"""What the terminal is given: tables that fit it, and colours where it has some."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from daemon.cli.terminal import echo_table

VERDICT = "0.312 mm against 0.411 mm of the live model on 60 fixes, better, see /var/lib/rigcal/models/7"


def test_the_words_of_a_table_s_last_column_wrap_where_the_terminal_is_narrow(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    echo_table(("model", "state", "comparison"), [("7", "live", VERDICT), ("8", "candidate", "not compared yet")])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 60
    assert lines[2].startswith("7      live       0.312 mm against")
    assert all(line.startswith(" " * 18) for line in lines[3:-1])
    assert " ".join(line[18:] for line in lines[2:-1]) == VERDICT, "nothing is cut short, and no path broken"
    assert lines[-1] == "8      candidate  not compared yet"


def test_a_table_that_goes_to_a_file_has_one_line_a_row(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    echo_table(("model", "comparison"), [("7", VERDICT)])
    assert capsys.readouterr().out.splitlines()[2] == f"7      {VERDICT}"


_COLOURED = "from daemon.cli.terminal import echo; echo('fault', fg='red')"


def test_a_terminal_without_colours_is_given_none() -> None:
    bare = {name: value for name, value in os.environ.items() if name not in ("TERM", "NO_COLOR")}
    assert _on_a_terminal(_COLOURED, bare | {"TERM": "xterm"}) == b"\x1b[31mfault\x1b[0m\r\n"
    assert _on_a_terminal(_COLOURED, bare | {"TERM": "dumb"}) == b"fault\r\n"
    assert _on_a_terminal(_COLOURED, bare | {"TERM": "xterm", "NO_COLOR": "1"}) == b"fault\r\n"


def _on_a_terminal(program: str, environment: dict[str, str]) -> bytes:
    """Return what a Python program writes on a terminal."""
    ours, theirs = os.openpty()
    try:
        subprocess.run([sys.executable, "-c", program], env=environment, stdout=theirs, check=True, timeout=30)
        return os.read(ours, 4096)
    finally:
        os.close(ours)
        os.close(theirs)
