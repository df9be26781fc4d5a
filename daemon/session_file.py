"""What a replay must know of a session that its captures do not tell: what the operator said."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.errors import DescriptionError
from drivers.files import read_whole

_FILE_MAX_BYTES = 1 << 20


class SessionFile(BaseModel):
    """An exported session, beside its captures.

    Attributes:
        prism, kind: as the session was started.
        since_utc_ns, until_utc_ns: from when to when it took fixes, on the time of its captures' logs.
        control_points: name -> place, mm, of those of its set-up: fixes there are not of the prism.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    prism: str
    kind: str
    since_utc_ns: int = Field(ge=0)
    until_utc_ns: int = Field(ge=0)
    control_points: dict[str, tuple[float, float, float]]


def read_session_file(path: Path) -> SessionFile:
    """What `rigcal session export` wrote of a session.

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
