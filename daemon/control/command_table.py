"""Every command of the control socket: what it does, whether it changes something, and the names of its arguments.

An argument that a command does not know is refused: one that is misspelt would else be taken for one that is absent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from daemon.commands import SESSION_KINDS, CommandError
from daemon.host.safe_output import shown

OPERATOR = "operator"  # who is responsible: of every command that changes something
_NAME_CHARACTERS = 80


@dataclass(frozen=True)
class Command:
    """A command of the control socket.

    Attributes:
        does: what it does, a sentence without its full stop.
        changes: it changes something.
        needed: its arguments that must be given, with what each means.
        optional: its other ones.
    """

    does: str
    changes: bool
    needed: Mapping[str, str]
    optional: Mapping[str, str]

    @property
    def known(self) -> tuple[str, ...]:
        """Names of all its arguments."""
        return (*self.needed, *self.optional, *([OPERATOR] if self.changes else ()))


def _looks(does: str, needed: Mapping[str, str] | None = None, **optional: str) -> Command:
    return Command(does, changes=False, needed=needed or {}, optional=optional)


def _changes(does: str, needed: Mapping[str, str] | None = None, **optional: str) -> Command:
    return Command(does, changes=True, needed=needed or {}, optional=optional)


_STEP = "`step.id` of the state, the step that is meant; refused (status 3) where another one is on by now"
_JOB, _MODEL = {"id": "number of the job"}, {"id": "number of the model"}

COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "status": _looks("tells the state of everything, as `rigcal status --json` does"),
        "rig.show": _looks("tells the rig's name and the text of its file"),
        "setup.new": _changes(
            "describes where the station stands now",
            {"id": "name of the set-up"},
            instrument="maker and model",
            serial="serial number",
            tilt_arcsec="residual tilt shown after levelling",
            ppm="atmospheric correction set on the instrument",
            prism_constants_mm="object: prism -> constant set for it, mm",
            control_points="object: name -> list of x, y, z, its known place in the station's frame, mm; a point "
            "without one is defined by its first shot",
            note="text that is kept with it",
        ),
        "setup.list": _looks("tells all set-ups with their control points"),
        "session.start": _changes(
            "opens a session",
            {"prism": "the prism that the station follows"},
            kind=f"{', '.join(f'`{kind}`' for kind in SESSION_KINDS)}; `static_poses` by default",
            setup="name of the station's set-up; the one described or used last by default",
            id="name of the session",
            note="text that is kept with it",
        ),
        "session.stop": _changes("closes the open session; its jobs follow by themselves"),
        "session.abort": _changes("closes the open session as unusable"),
        "session.shoot": _changes(
            "measures a control point; answers when that is done", {"point": "name of the control point"}
        ),
        "session.confirm-prism": _changes("says that the station is on the open session's prism"),
        "session.accept": _changes(
            "has calibration use a session that it would not use", {"id": "name of the session"}
        ),
        "session.list": _looks("tells all sessions"),
        "session.show": _looks("tells one session with its control points and jobs", {"id": "name of the session"}),
        "jobs.list": _looks("tells all jobs"),
        "jobs.cancel": _changes("cancels a job and those that wait for it", _JOB),
        "jobs.retry": _changes("queues a job again that did not end well", _JOB),
        "model.list": _looks("tells all models"),
        "model.show": _looks(
            "tells one model with its comparison and history", id="number of the model; the live one by default"
        ),
        "model.accept": _changes("makes a candidate the live model", _MODEL),
        "model.reject": _changes("retires a candidate", {**_MODEL, "reason": "text: why; kept with the model"}),
        "model.rollback": _changes(
            "puts back a model that was live", id="number of the model; the one that the live one replaced by default"
        ),
        "model.zeros-checked": _changes(
            "uses the live model, or the one that waits, and sessions with its zeros again after a joint's encoder has "
            "jumped"
        ),
        "model.compare": _changes("compares a model with the live one, by a job", _MODEL),
        "tip": _looks("tells where a prism is now", prism="which one; the configured one by default"),
        "alarms.list": _looks("tells the active alarms", all="true: also those that are over"),
        "alarms.test-notice": _changes("sends a test notice"),
        "devices.configure": _changes(
            "sets up CANopen devices", {"machine_is_parked": "true: the machine is parked and locked out"}
        ),
        "store.prune": _changes(
            "deletes captures and readings outside sessions", {"days": "those that are older than so many days go"}
        ),
        "store.redecode": _changes(
            "makes readings and fixes again from raw captures: of a session, or of some time",
            session="name of the session",
            first_utc_ns="begin of the time, where no session is named",
            last_utc_ns="its end",
        ),
        "guide.start": _changes(
            "opens a guide",
            setup="name of a set-up that exists; the one described or used last by default",
            new_setup="object with the arguments of `setup.new`: described now, in place of `setup`",
            control_points='list of names; those of the set-up by default, else `["cp1"]`',
            prisms="list of prisms, in the order to measure; all of the rig by default",
            plan='list of poses, each `{<joint column>: number, ..., "prisms": [names in view]}` as in '
            "`rigcal plan --json`; chosen on the spot by default",
            poses="most poses of a prism, 1 to 1000, 20 by default; not together with `plan`",
            check_poses="poses of the check, 3 to 5, 4 by default; 0 for no check",
            target_mm="expected RMS 3-D error over the work volume at which it is enough",
        ),
        "guide.state": _looks("tells the newest guide"),
        "guide.done": _changes("says that the step is carried out", step=_STEP),
        "guide.skip": _changes(
            "leaves the step out",
            {"reason": "text: why; kept"},
            step=_STEP,
            rest="true: all poses of this prism that are left",
        ),
        "guide.more": _changes(
            "measures more poses, at `enough`", poses="how many, 1 to 100, 5 by default", step=_STEP
        ),
        "guide.stop": _changes(
            "abandons the guide; its open session is closed if it has poses, else aborted",
            {"reason": "text: why; kept"},
        ),
        "simulation.visit": _changes(
            "sends a simulated boom to poses, and tells how many are `left`",
            poses="list of rows, as `rigcal plan --json` tells them; without any it only tells",
        ),
        "simulation.aim": _changes("turns a simulated station", {"target": "a prism or a control point"}),
    }
)
READING = frozenset(name for name, command in COMMANDS.items() if not command.changes)


def checked_arguments(name: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments that are given, without those that are null: null is none.

    Raises:
        CommandError: the command of that name does not know an argument, or lacks one.
    """
    command = COMMANDS[name]
    unknown = [shown(key, _NAME_CHARACTERS) for key in arguments if key not in command.known]
    if unknown:
        known = ", ".join(command.known) or "none"
        raise CommandError(f"{name}: unknown argument {', '.join(unknown)}; known: {known}")
    for key, meaning in command.needed.items():
        if arguments.get(key) is None:
            raise CommandError(f"{name}: argument {key} is missing: {meaning}")
    return {key: value for key, value in arguments.items() if value is not None}
