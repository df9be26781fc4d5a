"""`python -m simulators`: a simulated rig as a separate process.

Its links are two pseudo-terminals that it creates (`--can-port`, `--station-port`), or a real CAN interface and a real
serial device, to which any host can listen, including an installed service.

    python -m simulators --rig swdt82 --can socketcan:vcan0 --station-device /dev/ttyS1 --aim r --drive PLAN.csv --loop
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType

import numpy as np

from calibration.errors import RigError
from drivers.can.ports import Interface
from drivers.clock import ScaledClock, Stamp, SystemClock
from drivers.errors import LinkError
from simulators.blind.effect_draws import require_plausible
from simulators.blind.hiding import HiddenEffect, draw_hidden_effect
from simulators.devices.stations.total_station import StationSettings
from simulators.drive import PlanDriver
from simulators.effects.library import parse_effects
from simulators.faults import parse_faults, random_faults
from simulators.link_ends import BusEnd, CanEnd, SerialEnd, SlcanEnd, StationEnd
from simulators.live import LiveRig, print_line
from simulators.plan import Stop, read_plan
from simulators.pty_port import PtyPort
from simulators.rig.truth import RigTruth, load_rig, replace_effects
from simulators.rig_simulator import RigSimulator, SimulatorSettings
from simulators.wire_log import WireLog

HIDDEN = "hidden_effect.json"
INTERFACES: tuple[Interface, ...] = ("socketcan", "udp_multicast")
MAP_HELP = "TPDO mapping of a commissioned node, as hexadecimal words of object 1A00h: 38:60040020+65050010"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simulators", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--rig", required=True, help="a shipped rig's name or a path to a TOML file")
    add("--seed", type=int, default=0, help="seed of the machine and its noise")
    add("--perturbation", type=float, default=1.0, help="deviation of the machine, in build tolerances")
    add("--rate", type=float, default=1.0, help="simulated seconds per real second")
    add("--origin", type=_origin, help="UTC_NS,MONOTONIC_NS,BOOT_ID where simulated and real time agree")
    bus = parser.add_mutually_exclusive_group(required=True)
    bus.add_argument("--can-port", type=Path, help="path of the pseudo-terminal with an slcan adapter")
    bus.add_argument("--can", type=_interface, metavar="INTERFACE:CHANNEL", help="a real bus: socketcan:vcan0")
    add("--can-option", action="append", default=[], type=_option, metavar="NAME=VALUE", help="python-can option")
    line = parser.add_mutually_exclusive_group(required=True)
    line.add_argument("--station-port", type=Path, help="path of the station's pseudo-terminal")
    line.add_argument("--station-device", metavar="DEVICE", help="a real serial port, 8N1: /dev/ttyS1")
    add("--aim", metavar="TARGET", help="turn the station to a prism or control point at the start")
    add("--drive", type=Path, metavar="PLAN.csv", help="start at a plan's first pose, drive to the others and exit")
    add("--loop", action="store_true", help="repeat the plan endlessly")
    add("--dwell-s", type=float, default=5.0, help="minimum time at each pose; the plan may set a longer one")
    add("--speed", type=float, default=0.25, help="driving speed as a share of the joints' maximum rates")
    add("--effects", default="", help="hidden effects: FAMILY@WHERE[:NAME=VALUE...],...")
    add("--secret", type=Path, metavar="DIR", help=f"hide one more, randomly drawn effect; write it to {HIDDEN} in DIR")
    add("--faults", default="", help="scripted faults: KIND@SECONDS[:NAME=VALUE...],...")
    add("--random-faults", type=float, metavar="SECONDS", help="additional random faults at this mean interval")
    add("--bus-master", choices=("machine", "host"), default="machine", help="sender of SYNC and NMT start")
    add("--map", action="append", default=[], type=_mapping, metavar="NODE:WORD+WORD...", help=MAP_HELP)
    add("--sync-ms", type=float, default=50.0, help="the machine's SYNC interval")
    add("--signal-ms", type=float, default=10.0, help="cycle time of the machine's own signals")
    add("--setup", default="", help="name of the station set-up, which determines where the machine stands")
    add("--profile", choices=("topcon_gts8", "topcon_classic", "sokkia_set"), default="topcon_gts8")
    add("--baud", type=int, default=9600, help="baud rate of the station's line")
    add("--latency-ms", type=float, default=20.0, help="age of a measurement when its record starts")
    add("--push-s", type=float, help="interval at which the station sends records without request")
    add("--wire-log", type=Path, metavar="FILE", help="append the rig's traffic and measurements to this file")
    return parser


def _interface(text: str) -> tuple[Interface, str]:
    interface, _, channel = text.partition(":")
    if interface not in INTERFACES or not channel:
        raise argparse.ArgumentTypeError(f"{text!r} is not INTERFACE:CHANNEL; INTERFACE is {' or '.join(INTERFACES)}")
    return interface, channel


def _option(text: str) -> tuple[str, str | int]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, int(value) if value.lstrip("-").isdigit() else value


def _mapping(text: str) -> tuple[int, tuple[int, ...]]:
    try:
        node, words = text.split(":")
        return int(node), tuple(int(word, 16) for word in words.split("+"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not NODE:WORD+WORD...") from None


def _origin(text: str) -> Stamp:
    try:
        utc_ns, monotonic_ns, boot_id = text.split(",", 2)
        return Stamp(int(utc_ns), int(monotonic_ns), boot_id)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not UTC_NS,MONOTONIC_NS,BOOT_ID") from None


def _build(options: argparse.Namespace, start: Mapping[str, float] | None) -> tuple[RigSimulator, HiddenEffect | None]:
    if min(options.rate, options.sync_ms, options.signal_ms, options.baud) <= 0 or options.seed < 0:
        raise ValueError("rate, sync-ms, signal-ms and baud must be positive, seed not negative")
    if options.push_s is not None and options.push_s <= 0:
        raise ValueError("push-s must be positive")
    if options.latency_ms < 0:
        raise ValueError("latency-ms must not be negative")
    station = StationSettings(
        profile=options.profile,
        baud=options.baud,
        latency_s=options.latency_ms / 1e3,
        push_interval_s=options.push_s,
    )
    settings = SimulatorSettings(
        bus_master=options.bus_master,
        sync_period_s=options.sync_ms / 1e3,
        signal_period_s=options.signal_ms / 1e3,
        station=station,
        setup=options.setup,
        mappings=dict(options.map),
    )
    effects = parse_effects(options.effects)
    rig = load_rig(options.rig)
    require_plausible(rig, effects)
    truth = RigTruth(rig, options.seed, perturbation=options.perturbation, effects=effects)
    hidden = None
    if options.secret is not None:
        hidden = draw_hidden_effect(truth, np.random.default_rng([options.seed, 35]))
        truth = replace_effects(truth, [*effects, hidden.effect])
    faults = list(parse_faults(options.faults))
    if options.random_faults is not None:
        if options.random_faults <= 0:
            raise ValueError("random-faults must be positive")
        kinds = ("lock_loss", "prism_jump", "bad_check", "dropped_ack", "clutter", "joined_buffers")
        faults += random_faults(options.seed, 86_400.0, options.random_faults, kinds)
    return RigSimulator(truth, options.seed, settings, faults=faults, start=start), hidden


def _stops(options: argparse.Namespace) -> list[Stop]:
    """Return the stops of the plan to drive; empty without a plan."""
    if options.dwell_s < 0 or not 0 < options.speed <= 1:
        raise ValueError("dwell-s must not be negative, speed must be above 0 and at most 1")
    if options.drive is None:
        if options.loop:
            raise ValueError("--loop needs a plan: --drive PLAN.csv")
        return []
    stops = read_plan(options.drive, load_rig(options.rig), options.dwell_s)
    if options.loop and not any(stand_s for _, stand_s in stops) and len(stops) == 1:
        raise ValueError("--loop cannot repeat a plan with a single pose and no dwell; set --dwell-s")
    return stops


def _ends(options: argparse.Namespace, stack: contextlib.ExitStack) -> tuple[CanEnd, StationEnd]:
    """Open the rig's ends of its links; `stack` closes them."""
    bus = options.can
    can: CanEnd = SlcanEnd(options.can_port) if bus is None else BusEnd(bus[0], bus[1], dict(options.can_option))
    stack.callback(can.unplug)
    device = options.station_device
    station: StationEnd = PtyPort(options.station_port) if device is None else SerialEnd(device, options.baud)
    stack.callback(station.unplug)
    return can, station


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a simulated rig until its plan or, without a plan, its standard input ends; return the exit status."""
    options = _parser().parse_args(arguments)
    origin = options.origin or SystemClock().now()
    wake_read, wake_write = os.pipe()
    os.set_blocking(wake_write, False)

    def stop(signum: int, frame: FrameType | None) -> None:
        del signum, frame
        os.write(wake_write, b"x")

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with contextlib.ExitStack() as stack:
        try:
            log = None if options.wire_log is None else stack.enter_context(WireLog(options.wire_log))
            stops = _stops(options)
            simulator, hidden = _build(options, stops[0][0] if stops else None)
            clock = ScaledClock(options.rate, origin)
            driver = PlanDriver(simulator, stops, speed=options.speed, repeat=options.loop) if stops else None
            live = LiveRig(simulator, clock, *_ends(options, stack), print_line, log, driver)
            if options.aim is not None:
                simulator.aim(options.aim, 0.0)
            if hidden is not None:  # times of the effect count from simulated second 0
                told = json.dumps(hidden.as_dict() | {"begin_utc_ns": live.begin.utc_ns})
                (options.secret / HIDDEN).write_text(told, encoding="utf-8")
        except (RigError, LinkError, ValueError, OSError) as error:
            sys.stderr.write(f"simulators: {error}\n")
            return 2
        try:
            live.run(sys.stdin.fileno(), wake_read)
        except BrokenPipeError:  # the process that reads the answers has exited
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main())
