"""Checks of `rigcal doctor` on the computer, the configuration, and a running daemon.

They send nothing to a bus, instrument or server, open no device, and change nothing.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from daemon.cli.lines.state import LATE, channel_status
from drivers.can.bus_options import slcan_port
from drivers.readings import GapReason, Status

if TYPE_CHECKING:
    from daemon.config.config import Config
    from daemon.config.sections import CanSection

State = Literal["good", "warning", "fault", "unknown"]

NETWORK_DEVICES = Path("/sys/class/net")
_NETWORKD = "edit /etc/systemd/network/80-can0.network, then `systemctl restart systemd-networkd`"
_USUAL_RATE = 250_000  # bit/s
_RULES_FILE = "/etc/udev/rules.d/99-rigcal-station.rules"
_RELOAD_RULES = "`udevadm control --reload && udevadm trigger`"
_OFTEN = 10  # number of silences of a channel since the start that suggests a too short timeout
_CHANNELS_NAMED = 5  # of those that fall silent repeatedly
_LEAST_FREE = 0.1  # share of the disk
_BUSY = 1.5  # runnable processes per processor, averaged over the last minute
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
_TOOL_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        subject: what was checked.
        state: good, warning (works, but may soon fail), fault, or unknown (could not be checked).
        text: what was found.
        remedy: what to type or do; "" if nothing is needed.
    """

    subject: str
    state: State
    text: str
    remedy: str = ""

    def as_dict(self) -> dict[str, str]:
        """Return the JSON object."""
        return asdict(self)


# ---- the computer ----------------------------------------------------------------------------------------------------


def computer(config: Config | None) -> Iterator[Finding]:
    """Check the clock, the processor, the disk, the directory of backups, and whether the kernels are compiled.

    Args:
        config: of the daemon; None if there is none.
    """
    yield _clock()
    yield _processor()
    if config is not None:
        yield _disk(config)
        yield _backups(config)
    from daemon.warm_up import is_compiled

    if is_compiled():
        yield Finding("kernels", "good", "are compiled")
    else:
        remedy = "`python -m daemon.warm_up`, run by rigcal's Python, compiles them now"
        yield Finding(
            "kernels", "warning", "are not compiled yet: the first calibration takes half a minute longer", remedy
        )


def _clock() -> Finding:
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(512))  # modes 0: reads only
    except (OSError, AttributeError):
        state = -1
    if state == -1:
        return Finding("clock", "unknown", "the kernel does not report whether it is synchronised", "`timedatectl`")
    if state == _TIME_ERROR:
        return Finding(
            "clock",
            "warning",
            "is not synchronised: dates may be wrong (the order of records does not depend on this clock)",
            "`timedatectl set-ntp true`, or give the network a time server (/etc/systemd/timesyncd.conf)",
        )
    return Finding("clock", "good", "is synchronised")


def overload() -> str | None:
    """Return a clause about an overloaded processor; None if it is not overloaded.

    What looks like a faulty cable may be an overloaded processor.
    """
    processors = len(os.sched_getaffinity(0))
    wanting = os.getloadavg()[0]
    if wanting <= _BUSY * processors:
        return None
    return f"{wanting:.0f} processes compete for {processors} processor{'s' if processors != 1 else ''}"


def _processor() -> Finding:
    if busy := overload():
        remedy = "`top` shows the busy processes; a simulated rig needs less time with a lower --rate"
        return Finding("processor", "warning", f"{busy}: working devices may appear silent or to jump", remedy)
    return Finding("processor", "good", "is not overloaded")


def _disk(config: Config) -> Finding:
    place = config.state_directory
    existing = next((path for path in (place, *place.parents) if path.exists()), Path("/"))
    usage = shutil.disk_usage(existing)
    text = f"{usage.free / 2**30:.1f} GiB of {usage.total / 2**30:.0f} are free at {place}"
    if usage.free < config.store.free_bytes or usage.free < _LEAST_FREE * usage.total:
        why = f"{text}; captures outside sessions are deleted below {config.store.free_gb:g} GiB or a tenth of the disk"
        return Finding("disk", "warning", why, f"`du -xh --max-depth=2 {existing} | sort -h` shows what uses it")
    return Finding("disk", "good", text)


def _backups(config: Config) -> Finding:
    directory = config.store.backup_directory
    if directory is None:
        why = "none are made: if the disk fails, all sessions and models are lost"
        return Finding("backups", "warning", why, "set `backup_directory = ...` in [store] of the configuration")
    remedy = f"mount the disk for backups, then `install -d -o rigcal -g rigcal -m 0750 {directory}`"
    try:
        owner = directory.stat().st_uid
        if config.state_directory.exists() and owner != config.state_directory.stat().st_uid:
            why = f"{directory} does not belong to the owner of {config.state_directory}, who must write there"
            return Finding("backups", "warning", why, remedy)
    except OSError as error:
        return Finding("backups", "warning", f"{directory}: {error.strerror}", remedy)
    return Finding("backups", "good", f"are written to {directory}")


# ---- the configuration -----------------------------------------------------------------------------------------------


def read_configuration(path: Path) -> tuple[Config | None, Finding]:
    """Read a configuration with its rig and their DBC and EDS files; return it (None if unreadable) and the finding."""
    from calibration.errors import RigError
    from daemon.commands import CommandError
    from daemon.composition import decoders
    from daemon.config.config import read_config
    from daemon.rig_files import load_rig
    from drivers.errors import DescriptionError

    config = None
    try:
        config = read_config(path)
        source = load_rig(config.rig, named_in=path)
        decoders(config, source)
    except (CommandError, RigError, DescriptionError) as error:
        return config, Finding(
            "configuration", "fault", str(error), f"correct it, then run `rigcal config check {path}`"
        )
    return config, Finding("configuration", "good", f"{path}: rig {source.rig.name}")


def devices(config: Config) -> Iterator[Finding]:
    """Check the interfaces and ports of a configuration without opening them."""
    for section in config.can:
        if section.interface == "socketcan":
            yield can_interface(section, _link_details(section.channel), NETWORK_DEVICES / section.channel)
        elif section.interface == "slcan":
            port, key = Path(slcan_port(section.channel)), "[[can]] channel"
            yield _serial_port(
                section.name, port, key, f"plug it in, or correct {key}", "its name in /dev/serial/by-id"
            )
    for station in config.station:
        plug_in = f"plug it in; put its serial number into {_RULES_FILE}, then {_RELOAD_RULES}"
        key, lasting = "[station.serial] path", f"the name that {_RULES_FILE} gives to the adapter"
        yield _serial_port(station.name, Path(station.serial.path), key, plug_in, lasting)


def _link_details(channel: str) -> Mapping[str, Any] | None:
    """Return the output of `ip` (iproute2) about an interface; None if `ip` fails."""
    command = ["ip", "-json", "-details", "link", "show", "dev", channel]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TOOL_TIMEOUT_S, check=False)
        return dict(json.loads(done.stdout)[0]) if done.returncode == 0 else None
    except (OSError, subprocess.TimeoutExpired, ValueError, IndexError):
        return None


def can_interface(section: CanSection, details: Mapping[str, Any] | None, device: Path) -> Finding:
    """Check a CAN interface: present, up, listen-only unless the link may send, and with the configured bit rate.

    Args:
        section: the link.
        details: output of `ip -json -details link show` about its interface; None if `ip` failed.
        device: the interface's directory in /sys.
    """
    name = section.channel
    if not device.exists():
        seen = "`ip -details link show type can` lists the CAN interfaces, `dmesg` shows messages about the adapter"
        return Finding(name, "fault", f"there is no such interface (link {section.name})", seen)
    if details is None:
        return Finding(name, "unknown", "its settings cannot be read", "install the program ip: `apt install iproute2`")
    if "UP" not in details.get("flags", ()):
        up = f"`ip link set {name} up type can bitrate {section.bitrate or _USUAL_RATE} listen-only on`, or {_NETWORKD}"
        return Finding(name, "fault", "the interface is down", up)
    info = details.get("linkinfo", {})
    if info.get("info_kind") != "can":
        return Finding(name, "good", f"is up; a {info.get('info_kind') or 'network'} interface has no bit rate")
    return _controller(section, info.get("info_data", {}))


def _controller(section: CanSection, data: Mapping[str, Any]) -> Finding:
    """Check the controller of an interface that is up, from the data that the kernel reports."""
    rate, state = data.get("bittiming", {}).get("bitrate"), str(data.get("state", ""))
    is_listening = "LISTEN-ONLY" in data.get("ctrlmode", ())
    text = f"is up at {rate or 0:,} bit/s, {'listen-only' if is_listening else 'may transmit'}, {state.lower()}"
    found: State = "good"
    remedy = ""
    if state == "BUS-OFF":
        found, remedy = "fault", f"check cabling, termination (120 ohm at both ends) and bit rate; then {_NETWORKD}"
    elif section.bitrate is not None and rate is not None and rate != section.bitrate:
        found, text = "fault", f"{text}; the configuration has {section.bitrate:,} bit/s"
        remedy = f"set BitRate: {_NETWORKD}"
    elif section.allow_transmit and is_listening:
        found, text = "fault", f"{text}, and the link has allow_transmit = true"
        remedy = f"set ListenOnly=no: {_NETWORKD}"
    elif not section.allow_transmit and not is_listening:
        found, text, remedy = "warning", f"{text}: it acknowledges frames", f"set ListenOnly=yes: {_NETWORKD}"
    return Finding(section.channel, found, text, remedy)


def _serial_port(name: str, path: Path, key: str, plug_in: str, lasting: str) -> Finding:
    if not path.exists():
        plugged = ", ".join(
            sorted(str(p) for p in Path("/dev").glob("ttyUSB*")) + sorted(str(p) for p in Path("/dev").glob("ttyACM*"))
        )
        found = f"plugged in: {plugged}" if plugged else "no serial adapter is plugged in"
        return Finding(name, "fault", f"{path} does not exist; {found}", plug_in)
    if not path.is_char_device():
        return Finding(name, "fault", f"{path} is not a serial port", f"correct {key}")
    if not os.access(path, os.R_OK | os.W_OK):
        remedy = f"join its group: `sudo adduser {_user()} dialout`, then log in again (the service is in it already)"
        return Finding(name, "fault", f"{_user()} has no permission to open {path}", remedy)
    if path.resolve().name.startswith(("ttyUSB", "ttyACM")) and not path.is_symlink():
        remedy = f"use {lasting} as {key}"
        return Finding(name, "warning", f"{path} may name a different adapter after a restart", remedy)
    target = f" is {path.resolve()}" if path.is_symlink() else " exists"
    return Finding(name, "good", f"{path}{target}")


def _user() -> str:
    import getpass

    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return f"uid {os.getuid()}"


# ---- the daemon ------------------------------------------------------------------------------------------------------


def socket_finding(error: str) -> Finding:
    """Return the finding for a daemon that does not answer.

    Args:
        error: the client's error.
    """
    remedy = "`systemctl status rigcal` shows whether it runs, `journalctl -u rigcal -n 50` why not"
    return Finding("daemon", "fault", error, remedy)


def daemon_state(status: Mapping[str, Any], version: str) -> Iterator[Finding]:
    """Check the status of a running daemon: version, store, links, channels, station, timeouts, alarms.

    Args:
        status: the daemon's state.
        version: of this program.
    """
    if status.get("version", version) != version:
        text = f"version {status['version']} is running, but this program is version {version}"
        yield Finding("daemon", "warning", text, "`systemctl restart rigcal`")
    else:
        yield Finding("daemon", "good", f"answers, {status['mode']}, version {version}")
    store, acquisition = status["store_health"], status["acquisition"]
    hindrance = acquisition["error"] or (
        "a write to the store does not end" if acquisition.get("is_write_hung") else None
    )
    if hindrance:
        remedy = "`rigcal alarms` shows what to do; captures wait in memory meanwhile"
        yield Finding("store", "fault", f"nothing can be stored: {hindrance}", remedy)
    if store["state"] not in ("ok", "checking"):
        yield Finding(
            "store", "fault", store["text"], "`rigcal store check` checks all of it; see docs/how-to/back-up.md"
        )
    elif not hindrance:
        yield Finding("store", "good", f"{status['store']}: {store['text'] or 'no fault is known'}")
    for link in acquisition["links"]:
        yield _link(link, is_storing=not hindrance)
    late = "the computer does not keep up with decoding: `top` shows what is busy"
    if hindrance:
        late = "it is decoded once the store can be written"
    yield from channel_findings(acquisition["channels"], late)
    for station in acquisition["stations"]:
        yield _station(station, late)
    yield from _time_outs(acquisition)
    yield from _alarms(status["alarms"]["active"])


def _alarms(active: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """List critical alarms as a fault, and the others as a warning."""
    if not active:
        yield Finding("alarms", "good", "none")
    states: tuple[tuple[State, bool], ...] = (("fault", True), ("warning", False))
    for state, is_critical in states:
        alarms = [alarm for alarm in active if (alarm["severity"] == "critical") is is_critical]
        if alarms:
            named = ", ".join(f"{alarm['kind']} {alarm['subject']}" for alarm in alarms)
            yield Finding("alarms", state, named, "`rigcal alarms` shows what to do")


def _link(link: Mapping[str, Any], *, is_storing: bool) -> Finding:
    if link["up"] is False:
        return Finding(
            f"link {link['name']}", "fault", link["reason"] or "is closed", "check plug, adapter and its power"
        )
    if link["up"] and not is_storing:
        return Finding(f"link {link['name']}", "unknown", "is open; what it receives cannot be stored at present")
    if link["up"] and not link["captures_per_s"]:
        remedy = "check the device's power, the cable, and the bit rate or baud: a wrong rate looks the same"
        return Finding(f"link {link['name']}", "fault", "is open, but receives nothing", remedy)
    if link["dropped"]:
        text = f"{link['dropped']} captures were lost since the start: the computer or its disk is too slow"
        return Finding(f"link {link['name']}", "warning", text, "`top` shows the busy processes")
    return Finding(f"link {link['name']}", "good", f"{link['captures_per_s']:.0f} captures/s")


def channel_findings(channels: list[Mapping[str, Any]], late: str) -> Iterator[Finding]:
    """Check joints and signals; channels of one kind that fail for the same reason share a finding.

    Args:
        channels: their states.
        late: remedy for those whose readings wait to be decoded.
    """
    from daemon.acquisition.status.silence import START_NODES

    groups: dict[tuple[str, str, str], list[str]] = {}
    for channel in channels:
        if channel["status"] != "ok":
            since = channel_status(channel)
            if channel["age_s"] is None and since != LATE:
                since = "never heard"
            groups.setdefault((channel["kind"], since, channel.get("silence", "")), []).append(channel["name"])
    if channels and not groups:
        yield Finding("channels", "good", f"all {len(channels)} joints and signals are read")
    for (kind, since, silence), names in groups.items():
        state: State = "fault" if kind == "joint" else "warning"
        remedy = "check power and cable; `rigcal status --frames` shows which identifiers are received"
        if since == LATE:
            remedy = late
        elif silence:
            remedy = START_NODES
        why = f"; {silence}" if silence else ""
        yield Finding(f"{kind}s", state, f"{since}: {', '.join(names)}{why}", remedy)


def _station(station: Mapping[str, Any], late: str) -> Finding:
    from daemon.acquisition.status.present import LINK_DOWN, SILENT, STARTING

    name = f"station {station['name']}"
    if channel_status(station) == LATE:
        return Finding(name, "warning", station["sentence"], late)
    if station["age_s"] is None:
        remedy = "check its power, cable, baud and profile ([station] of the configuration)"
        return Finding(name, "fault", "has not answered since the daemon's start", remedy)
    if station["status"] == "ok":
        return Finding(name, "good", station["sentence"])
    remedies = {
        LINK_DOWN: "check the plug, the cable, and the power of adapter and station",
        SILENT: "check its power and cable, and that it still measures",
        STARTING: "wait some seconds; if nothing arrives, check its power and cable",
        Status.TIME_DOUBTFUL: "its records are read too late: check what keeps the computer busy",
    }
    aim = (
        "level it and switch its compensator on"
        if station.get("tilt_ok") is False
        else "aim it at the prism and lock it"
    )
    remedy = remedies.get(station["status"], aim)
    return Finding(name, "warning", station["sentence"], remedy)


def _time_outs(acquisition: Mapping[str, Any]) -> Iterator[Finding]:
    """Find channels that fall silent and return so often that their timeout may be too short."""
    often = {
        gap["channel"]: gap["count"]
        for gap in acquisition.get("gap_counts", ())
        if gap["reason"] == "silent" and gap["count"] >= _OFTEN
    }
    if not often:
        yield Finding("timeouts", "good", "no channel falls silent repeatedly")
        return
    worst = sorted(often, key=lambda name: -often[name])
    named = ", ".join(f"{name} {often[name]} times" for name in worst[:_CHANNELS_NAMED])
    more = f", and {len(worst) - _CHANNELS_NAMED} more" if len(worst) > _CHANNELS_NAMED else ""
    yield Finding("timeouts", "warning", f"silent since the start: {named}{more}", _time_out_remedy(acquisition))


def _time_out_remedy(acquisition: Mapping[str, Any]) -> str:
    """Return what to do about channels that fall silent; an overloaded processor comes before the rig file."""
    check = (
        "check their cables; if a device is only slow, give its channel in the rig file a longer timeout_s (a station: "
        "silence_timeout_s in the configuration)"
    )
    was_late = any(gap["reason"] == GapReason.TIME_DOUBTFUL for gap in acquisition.get("gap_counts", ()))
    if overload() is None and not was_late and not any(link["dropped"] for link in acquisition["links"]):
        return check
    return (
        f"an overloaded processor is the likely cause: relieve it first (`top` shows what is busy); otherwise {check}"
    )
