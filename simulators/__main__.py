"""`python -m simulators`: a simulated rig as a process of its own, on two ptys."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

import numpy as np

from calibration.errors import RigError
from drivers.clock import ScaledClock, Stamp, SystemClock
from simulators.blind.hiding import HiddenEffect, draw_hidden_effect
from simulators.devices.stations.total_station import StationSettings
from simulators.effects.library import parse_effects
from simulators.faults import parse_faults, random_faults
from simulators.live import LiveRig, print_line
from simulators.rig.truth import RigTruth, load_rig, replace_effects
from simulators.rig_simulator import RigSimulator, SimulatorSettings
from simulators.wire_log import WireLog

HIDDEN = "hidden_effect.json"
MAP_HELP = "what a commissioned node's TPDO carries, as hexadecimal words of object 1A00h: 38:60040020+65050010"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m simulators", description=__doc__)
    add = parser.add_argument
    add("--rig", required=True, help="a shipped rig's name or a path to a TOML file")
    add("--seed", type=int, default=0, help="the machine and its noise")
    add("--perturbation", type=float, default=1.0, help="deviation of the machine in build tolerances")
    add("--rate", type=float, default=1.0, help="simulated seconds per real second")
    add("--origin", type=_origin, help="UTC_NS,MONOTONIC_NS,BOOT_ID at which simulated and real time agree")
    add("--can-port", type=Path, required=True, help="where the slcan port appears")
    add("--station-port", type=Path, required=True, help="where the station's port appears")
    add("--effects", default="", help="hidden effects: FAMILY@WHERE[:NAME=VALUE...],...")
    add("--secret", type=Path, metavar="DIR", help=f"hide one more effect, drawn here, and name it in {HIDDEN} there")
    add("--faults", default="", help="scripted faults: KIND@SECONDS[:NAME=VALUE...],...")
    add("--random-faults", type=float, metavar="SECONDS", help="further faults at this mean interval")
    add("--bus-master", choices=("machine", "host"), default="machine", help="who starts the nodes and sends SYNC")
    add("--map", action="append", default=[], type=_mapping, metavar="NODE:WORD+WORD...", help=MAP_HELP)
    add("--sync-ms", type=float, default=50.0, help="the machine's SYNC interval")
    add("--signal-ms", type=float, default=10.0, help="cycle of the machine's own signals")
    add("--setup", default="", help="name of the station set-up: decides where the machine stands")
    add("--profile", choices=("topcon_gts8", "topcon_classic", "sokkia_set"), default="topcon_gts8")
    add("--baud", type=int, default=9600, help="of the station's line")
    add("--latency-ms", type=float, default=20.0, help="how old a measurement is when its record starts")
    add("--push-s", type=float, help="the station sends records unasked at this interval")
    add("--wire-log", type=Path, metavar="FILE", help="append the rig's traffic and measurements to this file")
    return parser


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


def _build(options: argparse.Namespace) -> tuple[RigSimulator, HiddenEffect | None]:
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
    truth = RigTruth(load_rig(options.rig), options.seed, perturbation=options.perturbation, effects=effects)
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
    return RigSimulator(truth, options.seed, settings, faults=faults), hidden


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a simulated rig until its standard input ends; returns the exit status."""
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
            simulator, hidden = _build(options)
            clock = ScaledClock(options.rate, origin)
            live = LiveRig(simulator, clock, options.can_port, options.station_port, print_line, log)
            if hidden is not None:  # its instants count from simulated second 0
                told = json.dumps(hidden.as_dict() | {"begin_utc_ns": live.begin.utc_ns})
                (options.secret / HIDDEN).write_text(told, encoding="utf-8")
        except (RigError, ValueError, OSError) as error:
            sys.stderr.write(f"simulators: {error}\n")
            return 2
        try:
            live.run(sys.stdin.fileno(), wake_read)
        except BrokenPipeError:  # the reader of the answers has ended
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        finally:
            live.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
