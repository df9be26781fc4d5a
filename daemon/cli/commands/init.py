"""`rigcal init`: a first configuration and rig file."""

from __future__ import annotations

import logging
import sys
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command import Command, json_option
from daemon.cli.lines.fill_in import fill_in_lines
from daemon.cli.terminal import echo, echo_error
from daemon.commands import CommandError
from daemon.host.safe_output import write_file

if TYPE_CHECKING:
    from daemon.cli.listening import HeardBus, HeardStation
    from daemon.cli.starter_files import JointChoice

CONFIG, RIG = "rigcal.toml", "rig.toml"
FIRST_NODE = 32
INTERFACES = ("socketcan", "slcan", "udp_multicast")


class _Profiles(click.Choice[str]):
    """A station profile's name; the profiles are searched for only when needed, as their import is slow."""

    def __init__(self) -> None:
        self.case_sensitive = True

    @cached_property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override] # click sets it only once
        """The names, the configuration's default first."""
        from drivers.stations.config import StationConfig
        from drivers.stations.profiles import station_profiles

        usual = StationConfig.model_fields["profile"].default
        return tuple(sorted(station_profiles(), key=lambda name: (name != usual, name)))


PROFILE = _Profiles()


@click.command(cls=Command)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path(),
    metavar="DIR",
    help=f"Directory for {CONFIG} and {RIG}; the current one by default. Existing files are never overwritten.",
)
@click.option("--rig", metavar="NAME", help="Name of a shipped rig; by default a new rig file is written.")
@click.option(
    "--joint",
    "joints",
    multiple=True,
    metavar="NAME:KIND:LOW:HIGH[:NODE]",
    help="Joint of the rig file, from the base outwards: theta1:revolute:-15:60:32 (deg), L2:prismatic:0:2168 (mm). "
    "May be repeated.",
)
@click.option(
    "--prism", "prisms", multiple=True, metavar="NAME", help="Prism of the rig file; `r` by default. May be repeated."
)
@click.option("--interface", type=click.Choice(INTERFACES), default="socketcan", show_default=True, help="CAN adapter.")
@click.option(
    "--channel", metavar="NAME", help="CAN interface, port or group; by default can0, or /dev/ttyACM0 for slcan."
)
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), help="Bit rate of the bus in bit/s, for slcan.")
@click.option("--station", "port", metavar="PORT", help="Serial port of the total station; `none` for no station.")
@click.option("--profile", type=PROFILE, help="Protocol of the station; the first in this list by default.")
@click.option("--baud", type=click.IntRange(50, 4_000_000), help="Baud of the station; 9600 by default.")
@click.option(
    "--listen",
    "listen_s",
    type=click.FloatRange(0, 600),
    default=0.0,
    metavar="SECONDS",
    help="Listen for this time to the bus, and to the station's port with each baud, to find settings that are not "
    "given; not at all by default. Nothing is sent.",
)
@click.option("--no-questions", is_flag=True, help="Ask no questions, as when standard input is not a terminal.")
@json_option
def init(out: Path, rig: str | None, *, no_questions: bool, as_json: bool, **given: Any) -> dict[str, Any]:
    """Write a commented configuration and rig file.

    The contents come from answers to questions or from listening. Settings that are detected on the bus (identifiers,
    CANopen nodes) and on serial ports (the baud that gives valid records of a station) are not asked for. Listening
    never transmits, so a station that sends only on request is not detected. The files pass `rigcal config check`;
    values that only the drawings have are marked FILL IN.
    """
    wanted = [out / CONFIG] if rig is not None else [out / CONFIG, out / RIG]
    for path in wanted:
        if path.exists():
            raise CommandError(f"{path} exists and is not overwritten; name a different directory with --out")
    if rig is not None:
        from calibration.rig.description import shipped_rigs

        if rig not in shipped_rigs():
            raise CommandError(f"there is no shipped rig {rig!r}; shipped: {', '.join(shipped_rigs())}")
    is_asking = not no_questions and not as_json and sys.stdin.isatty()
    answers = _answers(given, is_asking=is_asking)
    bus = _listen_to_bus(answers)
    station = _listen_to_station(answers)
    files = {CONFIG: _configuration(answers, rig or RIG, station)}
    if rig is None:
        files[RIG] = _rig(answers, bus, is_asking=is_asking)
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_file(out / name, text.encode())
    _check(out / CONFIG)
    if not as_json:
        _tell(out, files)
    return {
        "files": [str(out / name) for name in files],
        "heard": {
            "identifiers": {} if bus is None else {f"{key:X}": n for key, n in bus.identifiers.items()},
            "nodes": [] if bus is None else list(bus.nodes),
            "station": None
            if station is None
            else {"path": station.serial.path, "baud": station.serial.baud, "family": station.family},
        },
    }


# ---- answers ---------------------------------------------------------------------------------------------------------


def _answers(given: dict[str, Any], *, is_asking: bool) -> dict[str, Any]:
    """Return the options; missing ones are asked for or set to their defaults."""
    answers = dict(given)

    def answer(key: str, question: str, usual: str) -> None:
        if answers[key] is None:
            answers[key] = click.prompt(question, default=usual, err=True) if is_asking else usual

    usual_channel = "/dev/ttyACM0" if answers["interface"] == "slcan" else "can0"
    answer("channel", f"CAN interface ({answers['interface']})", usual_channel)
    _check_channel(answers)
    answer("port", "Serial port of the total station (none for no station)", _usual_port())
    if answers["port"] != "none" and not answers["listen_s"]:
        answer("profile", f"Its protocol ({', '.join(PROFILE.choices)})", PROFILE.choices[0])
        answer("baud", "Its baud", "9600")
    if is_asking and not answers["listen_s"] and click.confirm("Listen to bus and port for 5 s each?", err=True):
        answers["listen_s"] = 5.0
    return answers


def _check_channel(answers: dict[str, Any]) -> None:
    from drivers.can.bus_options import check_channel

    try:
        check_channel(answers["interface"], answers["channel"])
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--channel") from error


def _usual_port() -> str:
    from daemon.cli.listening import serial_ports

    return next(iter(serial_ports()), "/dev/rigcal-station")


# ---- listening -------------------------------------------------------------------------------------------------------


def _listen_to_bus(answers: dict[str, Any]) -> HeardBus | None:
    from daemon.cli.listening import hear_bus
    from drivers.can.ports import CanLinkConfig
    from drivers.clock import SystemClock
    from drivers.errors import LinkError

    if not answers["listen_s"]:
        return None
    logging.getLogger("can").setLevel(logging.ERROR)
    link = CanLinkConfig(
        name="boom", interface=answers["interface"], channel=answers["channel"], bitrate=answers["bitrate"]
    )
    echo_error(f"listening to {answers['channel']} for {answers['listen_s']:g} s")
    try:
        return hear_bus(link, answers["listen_s"], SystemClock())
    except LinkError as error:
        echo_error(f"Warning: {error}", logging.WARNING)
        return None


def _listen_to_station(answers: dict[str, Any]) -> HeardStation | None:
    from daemon.cli.listening import BAUDS, hear_station
    from drivers.clock import SystemClock
    from drivers.errors import LinkError

    if not answers["listen_s"] or answers["port"] == "none":
        return None
    bauds = BAUDS if answers["baud"] is None else (int(answers["baud"]),)
    echo_error(f"listening to {answers['port']} for {answers['listen_s']:g} s with each baud")
    try:
        heard = hear_station(answers["port"], answers["listen_s"], SystemClock(), bauds)
    except LinkError as error:
        echo_error(f"Warning: {error}", logging.WARNING)
        return None
    if heard is None:
        echo_error("no records of a station were received; a station that sends only on request cannot be detected")
    return heard


# ---- files -----------------------------------------------------------------------------------------------------------


def _configuration(answers: dict[str, Any], rig: str, heard: HeardStation | None) -> str:
    from daemon.cli.starter_files import configuration
    from drivers.stations.serial_port import SerialConfig

    station = None
    if answers["port"] != "none":
        usual = SerialConfig(path=answers["port"], baud=int(answers["baud"] or 9600))
        profile = answers["profile"] or (PROFILE.choices[0] if heard is None else "passive")
        station = (profile, "topcon" if heard is None else heard.family, usual if heard is None else heard.serial)
    return configuration(rig, answers["interface"], answers["channel"], answers["bitrate"], station)


def _rig(answers: dict[str, Any], bus: HeardBus | None, *, is_asking: bool) -> str:
    from daemon.cli.starter_files import rig_file

    texts = list(answers["joints"])
    if not texts and is_asking:
        echo_error(
            "Joints from the base outwards, as theta1:revolute:-15:60:32 or L2:prismatic:0:2168:48; an empty line ends."
        )
        while text := click.prompt("Joint", default="", show_default=False, err=True):
            texts.append(text)
    nodes = bus.nodes if bus is not None else ()
    if not texts:
        texts = [f"joint{i + 1}:revolute:-90:90:{node}" for i, node in enumerate(nodes or (FIRST_NODE,))]
    joints = [_joint(text, i, nodes) for i, text in enumerate(texts)]
    return rig_file("my_rig", joints, answers["prisms"] or ("r",), bus)


def _joint(text: str, place: int, nodes: tuple[int, ...]) -> JointChoice:
    """Parse NAME:KIND:LOW:HIGH[:NODE]; the default node is the next one that was detected, or a free number."""
    from daemon.cli.starter_files import JointChoice

    parts = text.split(":")
    try:
        name, kind, low, high = parts[0], parts[1], float(parts[2]), float(parts[3])
        node = int(parts[4]) if len(parts) > 4 else nodes[place] if place < len(nodes) else FIRST_NODE + place
        if kind not in ("revolute", "prismatic") or len(parts) > 5:
            raise ValueError
    except (ValueError, IndexError):
        raise click.BadParameter(
            f"{text!r}: write it as theta1:revolute:-15:60:32 (deg) or L2:prismatic:0:2168:48 (mm)",
            param_hint="--joint",
        ) from None
    return JointChoice(name, kind, (low, high), node)


def _check(path: Path) -> None:
    """Read the files as the daemon does.

    Raises:
        CommandError: an answer is invalid; the files are kept, to be corrected.
    """
    from calibration.errors import RigError
    from daemon.composition import decoders
    from daemon.config.config import read_config
    from daemon.rig_files import load_rig

    try:
        settings = read_config(path)
        decoders(settings, load_rig(settings.rig, named_in=path))
    except RigError as error:
        raise CommandError(f"the files are written but do not pass `rigcal config check {path}`: {error}") from error


def _tell(out: Path, files: dict[str, str]) -> None:
    for name in files:
        echo(f"wrote {out / name}")
    marked = sum(len(fill_in_lines(text)) for text in files.values())
    if marked:
        echo(f"fill in the values from the drawings at the {marked} places marked FILL IN")
    echo(f"then run `rigcal config check {out / CONFIG}` and `rigcal doctor --config {out / CONFIG}`")
