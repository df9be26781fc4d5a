"""The file of an exported session: the operator's commands and other facts that its captures do not contain."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.errors import DescriptionError
from drivers.files import read_whole
from drivers.readings import EventKind

_FILE_MAX_BYTES = 8 << 20  # every run of doubtful captures takes some 20


class DoubtfulCaptures(BaseModel):
    """Captures of doubtful time in a link's log, which cannot mark them itself.

    Attributes:
        captures: number of captures in the whole log, so that a different log is noticed.
        runs: number of the first and the last capture of each run, from 0 in the order of the log.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    captures: int = Field(gt=0)
    runs: tuple[tuple[int, int], ...]

    def is_among(self, number: int) -> bool:
        """Return True if the capture of that number is of doubtful time."""
        at = bisect_right(self.runs, number, key=lambda run: run[0]) - 1
        return at >= 0 and number <= self.runs[at][1]


class DeviceState(BaseModel):
    """The last report of a device on its own state before the logs begin.

    Attributes:
        device, kind, text, code: as in its event.
        utc_ns: instant of the event, on the time axis of the logs.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    device: str
    kind: EventKind
    text: str
    code: int | None = None
    utc_ns: int = Field(ge=0)


class SessionFile(BaseModel):
    """An exported session without its captures. All times are on the time axis of the logs.

    Attributes:
        prism, kind: prism and kind with which the session was started.
        since_utc_ns, until_utc_ns: start and end of the session.
        prism_confirmed_utc_ns: when an operator confirmed that the station was on the prism.
        prism_turned_utc_ns: when a program turned the station to the prism.
        away_utc_ns: start and end of each time at which the station was on no prism, as a guide knew; None in files of
            earlier versions, which do not contain it.
        control_points: name -> place, mm, of the control points of its set-up; fixes there are not of the prism.
        doubtful: link -> its captures of doubtful time; links without such captures are left out.
        can_channels: CAN link -> its channel number, from 1, in logs without channel names; empty in files of earlier
            versions.
        device_states: last reports of devices on their state before the logs begin, oldest first.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    prism: str
    kind: str
    since_utc_ns: int = Field(ge=0)
    until_utc_ns: int = Field(ge=0)
    control_points: dict[str, tuple[float, float, float]]
    prism_confirmed_utc_ns: tuple[int, ...] = ()
    prism_turned_utc_ns: tuple[int, ...] = ()
    away_utc_ns: tuple[tuple[int, int], ...] | None = None
    doubtful: dict[str, DoubtfulCaptures] = Field(default_factory=dict)
    can_channels: dict[str, int] = Field(default_factory=dict)
    device_states: tuple[DeviceState, ...] = ()


def read_session_file(path: Path) -> SessionFile:
    """Read the session file that `rigcal session export` wrote.

    Raises:
        DescriptionError: the file cannot be read, or is not a session file.
    """
    try:
        return SessionFile.model_validate_json(read_whole(path, _FILE_MAX_BYTES))
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise DescriptionError(
            str(path), f"is not the file of an exported session: {where}{': ' * bool(where)}{first['msg']}"
        ) from error
