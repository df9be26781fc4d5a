"""The composition root: builds links, decoders and clock from a configuration and a rig.

There is one function for each mode: live, simulated, replayed. No other module of `daemon` depends on the mode.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from calibration.rig.channels import Cia404Analogue, Cia406Encoder, Cia406Linear
from calibration.rig.description import Rig, parse_rig
from daemon.acquisition.channel_files import ChannelFiles, with_files
from daemon.acquisition.channels import decoder_factories, node_setups
from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.acquisition.simulated_channels import with_simulated_channels
from daemon.acquisition.simulated_rig import SimulatedRig, SimulationError
from daemon.commands import REFUSED, CommandError
from daemon.config.config import Config, ConfigError
from daemon.config.sections import CanSection
from daemon.rig_files import RigSource
from daemon.sessions.prisms.guard import MotionLimit
from daemon.sessions.replay import captures_of, first_captures
from drivers.can.channel import ChannelDecoder
from drivers.can.ports import CanLinkConfig, Interface
from drivers.can_decoder import CanDecoder
from drivers.can_link import CanLink
from drivers.canopen.node_setup import NodeSetup
from drivers.clock import NS_PER_S, SIMULATED_BOOT, Clock, ScaledClock, Stamp, SystemClock
from drivers.readings import Decoder, LinkLoop
from drivers.stations.decoder import StationDecoder
from drivers.stations.link import StationLink
from drivers.stations.serial_port import SerialConfig
from simulators.campaign import Campaign, simulate_campaign
from simulators.plan import plan_rows, stops_of
from simulators.replay import ReplayLink

SIMULATED_SYNC_MS = 200
_SIMULATED_RIG = "simulated-rig.toml"  # used if the configured rig has joints without a channel

Mode = Literal["live", "simulated", "replayed"]
_MACHINE = re.compile(f"{SIMULATED_BOOT}[0-9a-f]{{8}}-[0-9a-f]{{8}}-")  # earlier versions did not name the machine
_KERNEL_BOOT = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")  # random(4)


def _never() -> bool:
    return False


@dataclass(frozen=True)
class Parts:
    """The parts that the daemon runs.

    Attributes:
        mode: live, simulated or replayed, as shown in `status`.
        rig, rig_text: the machine and the text of its rig file, both including the decoding that DBC and EDS files
            define.
        clock: the clock that all parts use.
        links: loops that capture.
        decoders: link name -> factory of decoders for its captures.
        joiner: joins fixes with joint readings.
        aim: turns the station to a target; None if only an operator can.
        can_links: CAN links whose devices can be set up.
        visit: drives the boom to the rows of a pose plan and returns the number of remaining stops; None if only an
            operator drives it.
        turn: turns the simulated station in place of an operator's hand; None if the station is real or turns by
            itself.
        is_over: returns True once a replay has ended.
        rig_name: name of a shipped rig, or path of the rig file.
        has_simulation_ended: returns True once the process of a simulated rig has ended.
    """

    mode: Mode
    rig: Rig
    rig_text: str
    clock: Clock
    links: Sequence[LinkLoop]
    decoders: Mapping[str, Callable[[], Decoder]]
    joiner: ObservationJoiner
    aim: Callable[[str], None] | None = None
    visit: Callable[[Sequence[Mapping[str, Any]]], int] | None = None
    turn: Callable[[str], None] | None = None
    can_links: Sequence[CanLink] = ()
    is_over: Callable[[], bool] = _never
    rig_name: str = ""
    has_simulation_ended: Callable[[], bool] = _never


def live(
    config: Config, source: RigSource, clock: Clock | None = None, aim: Callable[[str], None] | None = None
) -> Parts:
    """Compose a real rig.

    Args:
        config: names the links.
        source: the rig.
        clock: the host's clock by default; a different one for a rig that is simulated at the configured ports.
        aim: turns the station to a target; None if only the operator can.
    """
    return _parts("live", config, source, clock or SystemClock(), aim=aim)


def simulated_machine(rig: str, seed: int, effects: Sequence[str], *, has_secret: bool) -> str:
    """Return the beginning of the boot ids of a simulated machine, which differs from that of any other machine.

    Args:
        rig: name of the rig.
        seed: seed of the machine.
        effects: its hidden effects, in the simulator's spelling.
        has_secret: whether it draws one further effect.
    """
    told = json.dumps([rig, seed, sorted(effects), has_secret])
    return f"{SIMULATED_BOOT}{hashlib.sha256(told.encode()).hexdigest()[:8]}-"


def require_apart(boots: Sequence[str], store: Path, machine: str | None, options: str = "") -> None:
    """Refuse to mix records of different machines in one store: models would be made of both.

    Args:
        boots: boot ids in the store.
        store: path of the store.
        machine: the simulated machine that is about to run on the store (`simulated_machine`); None for the real one.
        options: options of `rigcal run --sim` for the simulated machine of the store; "" if they are unknown.

    Raises:
        CommandError: the store holds records of a real machine and the present one is simulated, or the reverse, or of
            a different simulated machine.
    """
    is_simulated = machine is not None
    if machine and any(_MACHINE.match(boot) and not boot.startswith(machine) for boot in boots):
        raise CommandError(
            f"{store} was measured on a different simulated machine; start that one again with "
            f"{options or 'its --rig, --seed and --effect'}, or move {store.parent} away for a new one",
            REFUSED,
        )
    if is_simulated and any(_KERNEL_BOOT.fullmatch(boot) for boot in boots):
        raise CommandError(
            f"{store} holds records of a real machine, which must not be mixed with simulated ones; give --config a "
            "file with a different state_directory, or omit it",
            REFUSED,
        )
    if not is_simulated and any(boot.startswith(SIMULATED_BOOT) for boot in boots):
        raise CommandError(
            f"{store} holds records of a simulated rig, which must not be mixed with a real machine's; move "
            f"{store.parent} away, or set a different state_directory",
            REFUSED,
        )


@contextlib.contextmanager
def simulated(
    config: Config,
    source: RigSource,
    *,
    rate: float,
    seed: int,
    effects: tuple[str, ...],
    secret: Path | None = None,
    dwell_s: float,
    is_by_hand: bool = False,
    after_utc_ns: int = 0,
) -> Iterator[Parts]:
    """Compose a simulated rig that runs in its own process and uses real protocols, under the configured link names.

    Args:
        config: names the links.
        source: the rig.
        rate: simulated seconds per second.
        seed: determines the machine, the noise and the poses.
        effects: hidden effects, in the simulator's spelling.
        secret: directory in which the simulator records one further effect that it draws; None for no such effect.
        dwell_s: how long the boom stands still at each pose, in simulated seconds.
        is_by_hand: boom and station move only on command, in place of an operator's hands.
        after_utc_ns: end of the last run on the store: simulated time, which may have run fast, begins after it.
    """
    machine = simulated_machine(source.rig.name, seed, effects, has_secret=secret is not None)
    source, config = _with_devices(source, config)
    now = SystemClock().now()
    utc_ns = max(now.utc_ns, after_utc_ns + NS_PER_S)
    clock = ScaledClock(rate, Stamp(utc_ns, now.monotonic_ns, f"{machine}{uuid.uuid4()}"))
    ports = config.state_directory / "ports"
    ports.mkdir(parents=True, exist_ok=True)
    if len(config.can) > 1 or len(config.station) > 1:
        raise ConfigError("a simulated rig has one CAN link and one station; configure one [[can]] and one [[station]]")
    rates = {joint.name: joint.max_rate for joint in source.rig.joints}
    simulation = SimulatedRig(
        config.rig,
        rates,
        ports,
        clock,
        station_delay_s=next((station.link_delay_s for station in config.station), 0.0),
        seed=seed,
        effects=effects,
        secret=secret,
    )
    try:
        nodes = [c.node for c in source.rig.channels if isinstance(c, Cia406Encoder | Cia406Linear | Cia404Analogue)]
        bus = {
            "interface": "slcan",
            "channel": str(simulation.can_port),
            "bitrate": 250_000,
            "allow_transmit": True,
            "transmit_nodes": tuple(nodes),
            "sync_period_ms": SIMULATED_SYNC_MS,
            "options": {"sleep_after_open": 0.0},
        }
        line = SerialConfig(path=str(simulation.station_port))
        can = tuple(section.model_copy(update=bus) for section in config.can)
        station = tuple(section.model_copy(update={"serial": line}) for section in config.station)
        rewired = config.model_copy(update={"can": can, "station": station})
        turn = partial(_aim, simulation)
        parts = _parts("simulated", rewired, source, clock, aim=None if is_by_hand else turn)
        visit = partial(_visit, simulation, source.rig, dwell_s)
        parts = replace(
            parts, visit=visit, turn=turn if is_by_hand else None, has_simulation_ended=simulation.has_ended
        )
        simulation.drive_around(dwell_s, is_by_hand=is_by_hand)
        yield parts
    finally:
        simulation.close()


def _with_devices(source: RigSource, config: Config) -> tuple[RigSource, Config]:
    """Add a simulated device for every joint without a channel, in a rig file written for the simulation."""
    text = with_simulated_channels(source.rig, source.text)
    if text == source.text:
        return source, config
    path = config.state_directory / _SIMULATED_RIG
    path.write_text(text, encoding="utf-8")
    return RigSource(parse_rig(text, path.name), text, source.directory), config.model_copy(update={"rig": str(path)})


def simulated_campaign(
    rig: Rig, poses: int, seed: int, *, plan: Path | None, effects: str, noise_mm: float | None, recording: int
) -> Campaign:
    """Simulate a measuring campaign.

    Args:
        rig: the nominal machine.
        poses: number of poses.
        seed: determines the machine, the noise and random poses.
        plan: file with a pose plan; None for random poses.
        effects: hidden effects, in the simulator's spelling, separated by commas.
        noise_mm: standard deviation of each coordinate of a fix; None for that of the rig file's station.
        recording: number of the recording; a different number measures the same machine in different poses.

    Raises:
        ConfigError: an effect is unknown or has no place on the rig, or the file is not a plan for the rig.
    """
    try:
        rows = [] if plan is None else plan_rows(plan, rig)
        return simulate_campaign(rig, poses, seed, plan=rows, effects=effects, noise_mm=noise_mm, recording=recording)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _aim(simulation: SimulatedRig, target: str) -> None:
    try:
        simulation.aim(target)
    except SimulationError as error:
        raise CommandError(str(error)) from error


def _visit(simulation: SimulatedRig, rig: Rig, dwell_s: float, rows: Sequence[Mapping[str, Any]]) -> int:
    try:
        return simulation.visit(stops_of(rig, rows, dwell_s))
    except (SimulationError, ValueError) as error:
        raise CommandError(str(error)) from error


def replayed(config: Config, source: RigSource, files: Sequence[Path], speed: float) -> Parts:
    """Compose captured logs in place of a rig.

    Args:
        config: names the links.
        source: the rig.
        files: captured logs.
        speed: recorded seconds per real second.

    Raises:
        DescriptionError, ConfigError: a file is malformed, empty, or belongs to a link that is not configured.
    """
    starts = first_captures(files, config)
    first = min((capture.stamp for capture in starts.values()), key=lambda stamp: stamp.monotonic_ns)
    clock = ScaledClock(speed, first, SystemClock().monotonic_ns())
    links = [ReplayLink(starts[path].link, captures_of(path, config), clock) for path in files]

    def is_over() -> bool:
        return all(link.is_finished.is_set() for link in links)

    return _parts("replayed", config, source, clock, links=links, is_over=is_over)


def decoders(config: Config, source: RigSource, files: ChannelFiles | None = None) -> dict[str, Callable[[], Decoder]]:
    """Return link name -> factory of decoders for its captures.

    Args:
        config: names the links.
        source: the rig.
        files: the rig's DBC and EDS files if they were read already.

    Raises:
        ConfigError: a channel's link is not configured.
        DescriptionError: a DBC or EDS file is missing or malformed.
    """
    files = files or ChannelFiles.read(source.rig, source.directory)
    made: dict[str, Callable[[], Decoder]] = {}
    for section in config.can:
        factories = decoder_factories(source.rig, files, section.name)
        setups = node_setups(source.rig, files, section.name)
        permitted = [setup for setup in setups if setup.node in section.transmit_nodes]
        made[section.name] = partial(_can_decoder, section.name, factories, permitted)
        _check_identifiers(section.name, config.own_identifiers(section.name), factories)
    for station in config.station:
        made[station.name] = partial(StationDecoder, station)
    if config.tip is not None and config.tip.prism not in source.rig.prism_names:
        prisms = ", ".join(source.rig.prism_names)
        raise ConfigError(f"tip.prism: rig {source.rig.name!r} has no prism {config.tip.prism!r}; it has {prisms}")
    missing = sorted({c.link for c in source.rig.channels} - set(made))
    if missing:
        raise ConfigError(
            f"rig {source.rig.name!r} has channels on link {missing[0]!r}, which is not configured; add "
            f'[[can]] name = "{missing[0]}"'
        )
    return made


def joiner(config: Config, rig: Rig) -> ObservationJoiner:
    """Return a joiner of the configured stations' fixes with readings of the rig's joints and signals."""
    return ObservationJoiner(
        joint_inputs(rig),
        signal_inputs(rig),
        link_delay_s={station.name: station.link_delay_s for station in config.station},
        settle_s=config.sessions.settle_s,
    )


def motion_limits(config: Config) -> dict[str, MotionLimit]:
    """Return station name -> limit of its prism's motion."""
    return {station.name: MotionLimit.of_station(station) for station in config.station}


def _check_identifiers(link: str, own: Sequence[int], factories: Sequence[Callable[[], ChannelDecoder]]) -> None:
    """Raise ConfigError if rigcal would send under a CAN identifier that a device of the rig uses."""
    for factory in factories:
        channel = factory()
        if channel.arbitration_id in own and not channel.is_extended:
            raise ConfigError(
                f"tip.can.arbitration_id: {channel.arbitration_id:03X}h is in use by channel {channel.name!r} on link "
                f"{link!r}; choose a different identifier"
            )


def _can_decoder(link: str, factories: Sequence[Callable[[], ChannelDecoder]], setups: Sequence[NodeSetup]) -> Decoder:
    return CanDecoder(link, [factory() for factory in factories], setups)


def _parts(
    mode: Mode,
    config: Config,
    source: RigSource,
    clock: Clock,
    *,
    links: Sequence[LinkLoop] | None = None,
    aim: Callable[[str], None] | None = None,
    is_over: Callable[[], bool] = _never,
) -> Parts:
    source, files = with_files(source)
    can_links: list[CanLink] = []
    played: list[ReplayLink] = []
    for section in config.can:
        if section.interface == "playback":
            played.append(_playback(section, config, clock))
        else:
            own, is_simulated = config.own_identifiers(section.name), mode == "simulated"
            setups = node_setups(source.rig, files, section.name)
            can_links.append(
                _can_link(section, section.interface, setups, clock, own_identifiers=own, is_simulated=is_simulated)
            )
    stations = [StationLink(station, clock) for station in config.station]
    return Parts(
        mode=mode,
        rig=source.rig,
        rig_text=source.text,
        clock=clock,
        links=[*can_links, *played, *stations] if links is None else links,
        decoders=decoders(config, source, files),
        joiner=joiner(config, source.rig),
        aim=aim,
        can_links=can_links if links is None else (),
        is_over=is_over,
        rig_name=config.rig,
    )


def _playback(section: CanSection, config: Config, clock: Clock) -> ReplayLink:
    path, alone = Path(section.channel), config.model_copy(update={"can": (section,)})
    first, now = first_captures([path], alone)[path].stamp, clock.now()
    captures = (replace(capture, stamp=now.shifted(capture.stamp.since(first))) for capture in captures_of(path, alone))
    return ReplayLink(section.name, captures, clock)


def _can_link(
    section: CanSection,
    interface: Interface,
    setups: Sequence[NodeSetup],
    clock: Clock,
    *,
    own_identifiers: tuple[int, ...],
    is_simulated: bool,
) -> CanLink:
    config = CanLinkConfig(
        name=section.name,
        interface=interface,
        channel=section.channel,
        bitrate=section.bitrate,
        allow_transmit=section.allow_transmit,
        transmit_nodes=section.transmit_nodes,
        own_identifiers=own_identifiers,
        sync_period_ms=section.sync_period_ms,
        options=section.options,
    )
    return CanLink(config, clock, setups, configure_at_start=is_simulated)
