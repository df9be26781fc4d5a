"""State of every channel and station at this moment, from its last record and the age of that.

The last reading says what a device was when it was read. Whether it still is follows from its age and from its link:
status, alarms and interfaces all ask here, so that nothing old is shown as fresh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from calibration.rig.description import Rig
from daemon.config.config import Config
from daemon.host.safe_output import duration

STARTING = "starting"  # its link has not been opened yet, or the daemon has just begun to listen
SILENT = "silent"
LINK_DOWN = "link_down"

Kind = Literal["joint", "signal"]


@dataclass(frozen=True)
class ExpectedChannel:
    """A channel that the rig has.

    Attributes:
        name, unit: of the channel.
        link: that it is read from.
        kind: whether it is a joint of the boom.
        timeout_s: no reading for longer than this is silence.
    """

    name: str
    unit: str
    link: str
    kind: Kind
    timeout_s: float


@dataclass(frozen=True)
class ExpectedStation:
    """A station that is configured; its link has its name.

    Attributes:
        name: of the station.
        timeout_s: no record for longer than this is silence; 0 for a station that speaks only when it is told to.
    """

    name: str
    timeout_s: float


@dataclass(frozen=True)
class Expected:
    """Devices that should be heard.

    Attributes:
        channels: of the rig.
        stations: of the configuration.
    """

    channels: tuple[ExpectedChannel, ...] = ()
    stations: tuple[ExpectedStation, ...] = ()


NOTHING_EXPECTED = Expected()


def expected_of(config: Config, rig: Rig) -> Expected:
    """Return the devices that a configured rig should be heard by."""
    joints = rig.joint_names
    return Expected(
        tuple(
            ExpectedChannel(c.name, c.unit, c.link, "joint" if c.name in joints else "signal", c.timeout_s)
            for c in rig.channels
        ),
        tuple(ExpectedStation(station.name, station.silence_timeout_s) for station in config.station),
    )


def present_status(
    last: str | None, age_s: float | None, timeout_s: float, link_up: bool | None, link_since_s: float
) -> str:
    """The status that something has now.

    Args:
        last: its last status; None if it was never heard.
        age_s: since then; None if it was never heard.
        timeout_s: an older one is worth nothing any more; 0: it never grows too old.
        link_up: its link is open; None while that is not known.
        link_since_s: for how long that has been so.

    Returns:
        `last` while it is fresh, else LINK_DOWN; STARTING until a link that is open has had the time to bring
        something; SILENT after it.
    """
    if link_up is False:
        return LINK_DOWN
    if last is not None and age_s is not None and (timeout_s == 0 or age_s <= timeout_s):
        return last
    if link_up is None and last is None:
        return STARTING
    return SILENT if link_up is None or (timeout_s > 0 and link_since_s > timeout_s) else STARTING


def is_present(status: str) -> bool:
    """Return True if a status is that of a last reading, which is fresh."""
    return status not in (STARTING, SILENT, LINK_DOWN)


def station_sentence(status: str, age_s: float | None, last_lock: str, last_status: str, reason: str) -> str:
    """Return the state of a station in one clause: `locked, ok, 0 s ago` or `silent for 40 s (last: locked, ok)`."""
    words = {STARTING: "not heard yet", SILENT: "silent", LINK_DOWN: "link down"}
    if age_s is None:
        return words[status] if status == STARTING else f"{words[status]}, not heard since the start"
    last = f"{last_lock}, {last_status}" + (f" ({reason})" if reason else "")
    if is_present(status):
        return f"{last}, {duration(age_s)} ago"
    return f"{words[status]}, not heard for {duration(age_s)} (last: {last})"
