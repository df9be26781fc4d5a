"""The file of an exported session: the commands of its operator, which its captures do not tell."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.errors import DescriptionError
from drivers.files import read_whole
from drivers.readings import EventKind

_FILE_MAX_BYTES = 8 << 20  # every run of doubtful captures takes some 20


class DoubtfulCaptures(BaseModel):
    """Which captures of a link's log are of doubtful time: logs cannot say it.

    Attributes:
        captures: how many the log has in all, so that another one is noticed.
        runs: the first and the last of each run, counted from 0 in the order of the log.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    captures: int = Field(gt=0)
    runs: tuple[tuple[int, int], ...]

    def is_among(self, number: int) -> bool:
        """Return True if the capture of that number is of doubtful time."""
        at = bisect_right(self.runs, number, key=lambda run: run[0]) - 1
        return at >= 0 and number <= self.runs[at][1]


class DeviceState(BaseModel):
    """The last word of a device on its own state before the logs begin.

    Attributes:
        device, kind, text, code: as of its event.
        utc_ns: when, on the time of the logs.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    device: str
    kind: EventKind
    text: str
    code: int | None = None
    utc_ns: int = Field(ge=0)


class SessionFile(BaseModel):
    """An exported session, beside its captures.

    Attributes:
        prism, kind: as the session was started.
        since_utc_ns, until_utc_ns: from when to when it took fixes, on the time of its captures' logs.
        prism_confirmed_utc_ns: when an operator said that the station was on the prism, on the same time.
        prism_turned_utc_ns: when something turned the station to the prism, on the same time.
        control_points: name -> place, mm, of those of its set-up: fixes there are not of the prism.
        doubtful: link -> its captures of doubtful time; links without any are not there.
        can_channels: CAN link -> its channel number, from 1, in logs that have no names; empty in files of earlier
            versions.
        device_states: what devices had told of their state before the logs begin, oldest first.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    prism: str
    kind: str
    since_utc_ns: int = Field(ge=0)
    until_utc_ns: int = Field(ge=0)
    control_points: dict[str, tuple[float, float, float]]
    prism_confirmed_utc_ns: tuple[int, ...] = ()
    prism_turned_utc_ns: tuple[int, ...] = ()
    doubtful: dict[str, DoubtfulCaptures] = Field(default_factory=dict)
    can_channels: dict[str, int] = Field(default_factory=dict)
    device_states: tuple[DeviceState, ...] = ()


def read_session_file(path: Path) -> SessionFile:
    """Read the file that `rigcal session export` wrote of a session.

    Raises:
        DescriptionError: it cannot be read, or is no such file.
    """
    try:
        return SessionFile.model_validate_json(read_whole(path, _FILE_MAX_BYTES))
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise DescriptionError(
            str(path), f"is no exported session: {where}{': ' * bool(where)}{first['msg']}"
        ) from error
