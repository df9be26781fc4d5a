"""Every command of the control socket: what it does, whether it changes something, and the names of its arguments.

Unknown arguments are refused: otherwise a misspelt argument would be treated as absent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from daemon.commands import SESSION_KINDS, CommandError
from daemon.host.safe_output import shown

OPERATOR = "operator"  # who is responsible; an argument of every command that changes something
_NAME_CHARACTERS = 80


@dataclass(frozen=True)
class Command:
    """A command of the control socket.

    Attributes:
        does: what it does, as a sentence without a full stop.
        changes: whether it changes something.
        needed: required argument -> its meaning.
        optional: optional argument -> its meaning.
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


_STEP = "`step.id` of the state: the step that is meant; refused (status 3) if the guide is at a different step by now"
_JOB, _MODEL = {"id": "number of the job"}, {"id": "number of the model"}

COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "status": _looks("returns the state of everything, as `rigcal status --json` does"),
        "rig.show": _looks("returns the rig's name and the text of its file"),
        "setup.new": _changes(
            "describes where the station stands now",
            {"id": "name of the set-up"},
            instrument="maker and model",
            serial="serial number",
            tilt_arcsec="residual tilt shown after levelling",
            ppm="atmospheric correction set on the instrument",
            prism_constants_mm="object: prism -> constant set for it, mm",
            control_points="object: name -> list of x, y, z, its known place in the station's frame, mm; a point "
            "without a known place is defined by its first shot",
            note="text that is kept with the set-up",
        ),
        "setup.list": _looks("returns all set-ups with their control points"),
        "session.start": _changes(
            "opens a session",
            {"prism": "the prism that the station follows"},
            kind=f"{', '.join(f'`{kind}`' for kind in SESSION_KINDS)}; `static_poses` by default",
            setup="name of the station's set-up; the one described or used last by default",
            id="name of the session",
            note="text that is kept with the session",
        ),
        "session.stop": _changes("closes the open session; its jobs start by themselves"),
        "session.abort": _changes("closes the open session as unusable"),
        "session.shoot": _changes(
            "measures a control point; answers when the shot is done", {"point": "name of the control point"}
        ),
        "session.confirm-prism": _changes("confirms that the station is on the open session's prism"),
        "session.accept": _changes(
            "lets calibration use a session that it would otherwise not use", {"id": "name of the session"}
        ),
        "session.reject": _changes(
            "keeps calibration from using a closed session, until it is accepted",
            {"id": "name of the session"},
            reason="text: why; kept with the session",
        ),
        "session.list": _looks("returns all sessions"),
        "session.show": _looks("returns one session with its control points and jobs", {"id": "name of the session"}),
        "jobs.list": _looks("returns all jobs"),
        "jobs.cancel": _changes("cancels a job and the jobs that wait for it", _JOB),
        "jobs.retry": _changes("queues a job again that did not succeed", _JOB),
        "model.list": _looks("returns all models"),
        "model.show": _looks(
            "returns one model with its comparison and history", id="number of the model; the live one by default"
        ),
        "model.accept": _changes("makes a candidate the live model", _MODEL),
        "model.reject": _changes(
            "retires a candidate or the live model", {**_MODEL, "reason": "text: why; kept with the model"}
        ),
        "model.rollback": _changes(
            "makes a formerly live model live again",
            id="number of the model; the one that the live model replaced by default",
        ),
        "model.zeros-checked": _changes(
            "confirms the joints' zeros after a joint's encoder has jumped: the live or the waiting model, and "
            "sessions with its zeros, are used again"
        ),
        "model.compare": _changes("compares a model with the live one, by a job", _MODEL),
        "tip": _looks("returns the present place of a prism", prism="name of the prism; the configured one by default"),
        "alarms.list": _looks("returns the active alarms", all="true: also cleared alarms"),
        "alarms.test-notice": _changes("sends a test notice"),
        "devices.configure": _changes(
            "sets up CANopen devices", {"machine_is_parked": "true: the machine is parked and locked out"}
        ),
        "store.prune": _changes(
            "deletes captures and readings outside sessions", {"days": "age in days above which they are deleted"}
        ),
        "store.redecode": _changes(
            "decodes raw captures again into readings and fixes: of a session, or of a period",
            session="name of the session",
            first_utc_ns="start of the period, where no session is named",
            last_utc_ns="end of the period",
        ),
        "guide.start": _changes(
            "opens a guide",
            setup="name of a set-up that exists; the one described or used last by default",
            new_setup="object with the arguments of `setup.new`: a set-up to describe now, instead of `setup`",
            control_points='list of names; the points of the set-up by default, `["cp1"]` if it has none',
            prisms="list of prisms, in the order to measure; all of the rig by default",
            plan='list of poses, each `{<joint column>: number, ..., "prisms": [names in view]}` as in '
            "`rigcal plan --json`; chosen during the guide by default",
            poses="largest number of poses per prism, 1 to 1000, 20 by default; not together with `plan`",
            check_poses="poses of the check, 3 to 5, 4 by default; 0 for no check",
            target_mm="expected RMS 3-D error over the work volume, in mm, at which the poses are enough",
        ),
        "guide.state": _looks("returns the newest guide"),
        "guide.done": _changes("confirms that the step was carried out", step=_STEP),
        "guide.skip": _changes(
            "skips the step",
            {"reason": "text: why; kept"},
            step=_STEP,
            rest="true: skip all remaining poses of this prism",
        ),
        "guide.more": _changes(
            "measures more poses, at the step `enough`", poses="how many, 1 to 100, 5 by default", step=_STEP
        ),
        "guide.stop": _changes(
            "abandons the guide; its open session is closed if it has poses, otherwise aborted",
            {"reason": "text: why; kept"},
        ),
        "simulation.visit": _changes(
            "sends a simulated boom to poses, and returns how many are `left`",
            poses="list of rows, as in `rigcal plan --json`; without poses the command only returns the number",
        ),
        "simulation.aim": _changes("turns a simulated station", {"target": "a prism or a control point"}),
    }
)
READING = frozenset(name for name, command in COMMANDS.items() if not command.changes)


def checked_arguments(name: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Check the arguments of a command, and return those that are not null; null counts as absent.

    Args:
        name: name of the command.
        arguments: its arguments as given.

    Raises:
        CommandError: an argument is unknown to the command, or a required one is missing.
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
