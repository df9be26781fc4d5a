"""Present state of every channel and station, from its last record, the record's age and the link.

The last reading gives the state of a device when it was read. Its age and its link decide whether that is still valid.
Status, alarms and interfaces all use this module, so that no old value is shown as fresh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from calibration.rig.description import Rig
from daemon.acquisition.channel_files import CanopenChannel
from daemon.config.config import Config
from daemon.host.safe_output import duration

STARTING = "starting"  # the link is not open yet, or the daemon has just begun to listen
SILENT = "silent"
LINK_DOWN = "link_down"

Kind = Literal["joint", "signal"]


@dataclass(frozen=True)
class ExpectedChannel:
    """A channel of the rig.

    Attributes:
        name, unit: name and unit of the channel.
        link: link from which it is read.
        kind: joint of the boom, or signal.
        timeout_s: without a reading for longer than this the channel is silent.
        node: number of the CANopen node that sends it; None for other devices.
    """

    name: str
    unit: str
    link: str
    kind: Kind
    timeout_s: float
    node: int | None = None


@dataclass(frozen=True)
class ExpectedStation:
    """A configured station; its link has the same name.

    Attributes:
        name: name of the station.
        timeout_s: without a record for longer than this the station is silent; 0 for a station that sends only on
            request.
    """

    name: str
    timeout_s: float


@dataclass(frozen=True)
class Expected:
    """Devices from which data are expected.

    Attributes:
        channels: channels of the rig.
        stations: stations of the configuration.
    """

    channels: tuple[ExpectedChannel, ...] = ()
    stations: tuple[ExpectedStation, ...] = ()


NOTHING_EXPECTED = Expected()


def expected_of(config: Config, rig: Rig) -> Expected:
    """Return the devices from which a configured rig should receive data."""
    joints = rig.joint_names
    return Expected(
        tuple(
            ExpectedChannel(
                c.name,
                c.unit,
                c.link,
                "joint" if c.name in joints else "signal",
                c.timeout_s,
                c.node if isinstance(c, CanopenChannel) else None,
            )
            for c in rig.channels
        ),
        tuple(ExpectedStation(station.name, station.silence_timeout_s) for station in config.station),
    )


def present_status(
    last: str | None, age_s: float | None, timeout_s: float, link_up: bool | None, link_since_s: float
) -> str:
    """Return the present status of a channel or station.

    Args:
        last: status of its last record; None without a record.
        age_s: age of that record; None without a record.
        timeout_s: a record older than this is no longer valid; 0 for no limit.
        link_up: whether its link is open; None while unknown.
        link_since_s: for how long the link has been in this state.

    Returns:
        LINK_DOWN if the link is closed; `last` while its record is fresh; STARTING until an open link has had time to
        receive a record; otherwise SILENT.
    """
    if link_up is False:
        return LINK_DOWN
    if last is not None and age_s is not None and (timeout_s == 0 or age_s <= timeout_s):
        return last
    if link_up is None and last is None:
        return STARTING
    return SILENT if link_up is None or (timeout_s > 0 and link_since_s > timeout_s) else STARTING


def is_present(status: str) -> bool:
    """Return True if a status is that of a fresh record."""
    return status not in (STARTING, SILENT, LINK_DOWN)


def station_sentence(
    status: str, age_s: float | None, last_lock: str, last_status: str, reason: str, *, is_late: bool = False
) -> str:
    """Return the state of a station in one clause, such as `locked, ok, 0 s ago`.

    Args:
        status: present status of the station.
        age_s: age of its last record; None without a record.
        last_lock: lock of its last record.
        last_status: status of its last record.
        reason: reason in its last record; "" if it has none.
        is_late: whether newer records may wait to be stored or decoded, so that it is not known to be silent.
    """
    words = {STARTING: "nothing received yet", SILENT: "late" if is_late else "silent", LINK_DOWN: "link down"}
    done = "decoded" if is_late else "received"
    if age_s is None:
        return words[status] if status == STARTING else f"{words[status]}, nothing {done} since the start"
    last = f"{last_lock}, {last_status}" + (f" ({reason})" if reason else "")
    if is_present(status):
        return f"{last}, {duration(age_s)} ago"
    return f"{words[status]}, nothing {done} for {duration(age_s)} (last: {last})"
