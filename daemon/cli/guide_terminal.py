"""`rigcal session guide` on a terminal: live lines and keys on a terminal, else plain lines."""

from __future__ import annotations

import contextlib
import csv
import re
import select
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from daemon.cli.terminal import begin_screen, draw_screen, echo, end_screen
from daemon.commands import WRONG_USE, CommandError
from daemon.host.safe_output import shown

LOOK_S = 0.2
GO_ON = "`rigcal session guide` resumes it"
_BAR = 20  # characters
_NUMBER = re.compile(r"\d+(\.\d+)?")

Say = Callable[..., Mapping[str, Any]]
"""Sends a `guide.*` command with its arguments, and returns the guide's state."""


def plan_rows(path: Path) -> list[dict[str, Any]]:
    """Read a plan in the format of `rigcal plan --out`, for `guide.start`.

    Raises:
        CommandError: the file cannot be read, or a cell is not a number.
    """
    rows: list[dict[str, Any]] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            for line, row in enumerate(csv.DictReader(file, strict=True), start=2):
                try:
                    numbers = {
                        key: float(cell) for key, cell in row.items() if key and cell and key.endswith(("_deg", "_mm"))
                    }
                except ValueError as error:
                    raise CommandError(f"{path}, line {line}: {error}", WRONG_USE) from None
                seen = {"prisms": row["prisms"].split()} if row.get("prisms") else {}
                rows.append(numbers | seen)
    except OSError as error:
        raise CommandError(f"{path}: {error.strerror}", WRONG_USE) from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: {error}", WRONG_USE) from None
    if not rows:
        raise CommandError(f"{path}: contains no poses; `rigcal plan --out CSV` writes a plan", WRONG_USE)
    return rows


# ---- leading ---------------------------------------------------------------------------------------------------------


def lead(say: Say) -> Mapping[str, Any]:
    """Show each step until the guide is over, and obey keys; return the last state.

    Ctrl-C leaves the guide open.
    """
    try:
        if sys.stdin.isatty() and sys.stdout.isatty():
            return _lead_watched(say)
        return _lead_in_lines(say)
    except CommandError as error:
        raise CommandError(f"{error}; an open guide is kept, and {GO_ON}", error.status) from error
    except KeyboardInterrupt:
        echo()
        echo(f"the guide stays open; {GO_ON}")
        raise click.exceptions.Exit(0) from None


def _lead_in_lines(say: Say) -> Mapping[str, Any]:
    """Print each step, its targets and its messages once; print a message again if it returns after a different one.

    A message in which only numbers change, such as an age, is not printed again.
    """
    told: list[str] = []
    warned: list[str] = []
    while True:
        guide = _guide(say("guide.state"))
        step = guide["step"]
        how = f" (`rigcal session guide --done`: {step['button']})" if step["button"] else ""
        lines = [f"{step['title']}: {step['instruction']}{how}", *_target_lines(guide)]
        messages = [f"  {message['severity']}: {message['text']}" for message in guide["messages"]]
        new = [line for line in messages if _NUMBER.sub("", line) not in warned]
        for line in (*(line for line in lines if line not in told), *new):
            echo(line)
        told, warned = lines, [_NUMBER.sub("", line) for line in messages] if new else warned
        if guide["state"] != "open":
            return guide
        time.sleep(LOOK_S)


def _lead_watched(say: Say) -> Mapping[str, Any]:
    """Redraw the current step five times a second."""
    note = ""
    begin_screen()
    try:
        with _keys() as key:
            while True:
                guide = _guide(say("guide.state"))
                columns, rows = shutil.get_terminal_size()
                lines = [*screen(guide, columns), *([note] if note else [])]
                hidden = max(0, len(lines) - rows + 1)  # in the middle, as the step is at the top and the keys below
                draw_screen([(line, {}) for line in (*lines[: len(lines) - hidden - 2], *lines[-2:])])
                if guide["state"] != "open":
                    break
                pressed = key(LOOK_S)
                if pressed:
                    note = _obey(pressed, guide["step"], say)
    finally:
        end_screen()
    for line in lines:
        echo(line)
    return guide


def _obey(pressed: str, step: Mapping[str, Any], say: Say) -> str:
    """Carry out a key's command; return a note for the operator, "" for none."""
    try:
        if pressed in "\r\n d":
            say("guide.done", step=step["id"])
        elif pressed == "s":
            return _with_reason(say, step, rest=False)
        elif pressed == "e":
            return _with_reason(say, step, rest=True)
        elif pressed == "m":
            say("guide.more")
        elif pressed == "q":
            raise KeyboardInterrupt
    except CommandError as error:
        return shown(str(error))
    return ""


def _with_reason(say: Say, step: Mapping[str, Any], *, rest: bool) -> str:
    reason = ""
    with _line_mode(), contextlib.suppress(click.Abort):
        reason = click.prompt("why", default="", show_default=False)
    if not reason.strip():
        return "nothing was skipped: give a reason"
    say("guide.skip", step=step["id"], reason=reason, rest=rest)
    return ""


# ---- what is shown ---------------------------------------------------------------------------------------------------


def screen(guide: Mapping[str, Any], width: int) -> list[str]:
    """Return the lines of a guide's current step, wrapped to the terminal's width in columns."""
    step = guide["step"]
    lines = [f"Guide {guide['id']}, step {step['number']} of {step['of']}: {step['title']}", step["instruction"]]
    lines.append(step["why"])
    if guide["hold"] is not None:
        lines += [*map(_joint_line, guide["joints"]), _hold_line(guide)]
    lines += _gain_lines(guide)
    lines += [f"{message['severity']}: {message['text']}" for message in guide["messages"]]
    lines.append(_keys_line(step))
    room = max(20, width - 1)
    return [part for line in lines for part in textwrap.wrap(shown(line), room, subsequent_indent="  ")]


def _target_lines(guide: Mapping[str, Any]) -> list[str]:
    """Return the target values of the joints for the current pose, on one line; none in a step without a pose."""
    if guide["hold"] is None:
        return []
    targets = (f"{joint['name']} {joint['target']:.1f} {joint['unit']}" for joint in guide["joints"])
    return [f"  targets: {', '.join(targets)}"]


def _joint_line(joint: Mapping[str, Any]) -> str:
    if joint["now"] is None:
        return f"  {joint['name']:8} not read"
    arrow = "there" if joint["is_there"] else f"{joint['difference']:+8.1f} to go"
    stale = "" if joint["is_fresh"] else "  (old)"
    return f"  {joint['name']:8} {joint['now']:8.1f} -> {joint['target']:8.1f} {joint['unit']:3}  {arrow}{stale}"


def _hold_line(guide: Mapping[str, Any]) -> str:
    hold, poses = guide["hold"], guide["poses"]
    stands = "moves" if hold["since_s"] is None else f"stands for {hold['since_s']:.0f} s"
    boom = f"The boom {stands}" if hold["is_known"] else "The joints are not read now"
    return (
        f"{boom}; {hold['fixes']} of {hold['needed_fixes']} fixes; {poses['done']} of {poses['planned']} "
        f"poses of prism {guide['prism']}"
    )


def _gain_lines(guide: Mapping[str, Any]) -> Iterator[str]:
    accuracy, coverage = guide["accuracy"], guide["coverage"]
    if accuracy is None:
        return
    if accuracy["now_mm"] is None:
        yield f"Expected accuracy: {accuracy['why']}"
    else:
        target = f", target {accuracy['target_mm']:g} mm" if accuracy["target_mm"] is not None else ""
        yield (
            f"Expected error over the work volume: {accuracy['now_mm']:.2f} mm, after 5 more poses "
            f"{accuracy['after_5_mm']:.2f} mm{target}"
        )
    if coverage is not None and guide["prism"] is not None:
        share = coverage["prism_volume_share"]
        filled = round(_BAR * share)
        yield f"Work volume enclosed by prism {guide['prism']}: [{'#' * filled:{_BAR}}] {share:.0%}"


def _keys_line(step: Mapping[str, Any]) -> str:
    keys = []
    if step["button"]:
        keys.append(f"Enter: {step['button']}")
    if step["can_skip"]:
        keys.append("s: skip with a reason")
    commands = [(other["command"], other["button"]) for other in step["others"]]
    keys += [f"{'m' if command == 'guide.more' else 'e'}: {button}" for command, button in commands]
    keys.append("Ctrl-C: leave it open")
    return " | ".join(keys)


def summary(state: Mapping[str, Any]) -> None:
    """Print the guide's state once."""
    guide = state["guide"]
    if guide is None:
        echo("no guide yet; `rigcal session guide --prisms w,b,r,s` starts one")
        return
    for line in screen(guide, 10_000)[:-1]:
        echo(line)
    skipped = [(row["title"], row["reason"]) for row in guide["steps"] if row["state"] == "skipped"]
    skipped += [
        (f"{row['title']}, pose {one['pose']}", one["reason"])
        for row in guide["steps"]
        for one in (row["poses"] or {"skipped": ()})["skipped"]
        if row["state"] != "skipped"
    ]
    for title, reason in skipped:
        echo(f"  skipped: {title} ({reason})")


def _guide(state: Mapping[str, Any]) -> Mapping[str, Any]:
    guide = state["guide"]
    if guide is None:
        raise CommandError("no guide is open; `rigcal session guide --prisms w,b,r,s` starts one")
    return dict(guide)


# ---- keys ------------------------------------------------------------------------------------------------------------

_saved: list[list[Any]] = []  # of the terminal, while keys are read one by one


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """Read keys without Enter; yield a function that waits up to a timeout for a key and returns it, "" for none."""
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    _saved.append(before)

    def key(timeout_s: float) -> str:
        ready, _, _ = select.select([descriptor], [], [], timeout_s)
        return sys.stdin.read(1) if ready else ""

    try:
        tty.setcbreak(descriptor)
        yield key
    finally:
        _saved.pop()
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


@contextlib.contextmanager
def _line_mode() -> Iterator[None]:
    """Switch the terminal back to whole lines within the block."""
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    termios.tcsetattr(descriptor, termios.TCSADRAIN, _saved[-1])
    try:
        yield
    finally:
        tty.setcbreak(descriptor)


def names(text: str | None) -> Sequence[str] | None:
    """Return the names in a comma-separated list; None if `text` is None."""
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]
