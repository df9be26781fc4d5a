"""Makes golden cases anew: `python -m tests.golden.regenerate [simulated/NAME | real/NAME ...]`.

Each case is a folder: captured logs (`boom.log`, `station.serial`), the configuration they are of, and the readings
that they must yield (`readings.jsonl`). Simulated cases are made whole, all of them where none is named. The logs of
real cases come from their sources: only their readings are made, and only where the case is named. Say in the commit
why a golden changed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from click.testing import CliRunner

from calibration.rig.description import shipped_rig
from daemon.cli.main import main
from drivers.clock import ManualClock
from drivers.logs.can_log import write_can_log
from drivers.logs.serial_log import SerialLogHeader, SerialLogWriter
from drivers.readings import CanCapture, SerialCapture
from simulators.devices.stations.total_station import StationSettings
from simulators.faults import parse_faults
from simulators.rig.truth import RigTruth
from simulators.rig_simulator import RigSimulator, SimulatorSettings
from tests.simulated.captures import Step, generate
from tests.simulated.scripted_host import ScriptedHost

HERE = Path(__file__).parent
SIMULATED, REAL = HERE / "simulated", HERE / "real"
CAN_SUFFIXES = ("log", "asc", "blf")
NODES = (32, 33, 34, 35, 36, 37, 38, 48, 49, 50, 60)
CONFIG = """rig = "swdt82"
state_directory = "."

[[can]]
channel = "can0"

[[station]]
profile = "{profile}"
{options}serial.path = "/dev/rigcal-station"
"""


@dataclass(frozen=True)
class Case:
    """A simulated case.

    Attributes:
        duration_s: how long it lasts.
        station: what the instrument is.
        faults: what goes wrong, as the simulator spells it.
        plan: what whoever drives the rig does.
        formats: of the CAN log.
        host: rigcal sets up the nodes, sends SYNC and polls; else it only listens.
        prism: of the session that the replay takes the fixes for; "" for none.
    """

    duration_s: float
    station: StationSettings = field(default_factory=StationSettings)
    faults: str = ""
    plan: Sequence[Step] = (Step(0.0, aim="r"),)
    formats: tuple[str, ...] = ("log",)
    host: bool = True
    prism: str = ""


CASES = {
    "standing": Case(6.0, formats=("log", "asc", "blf")),
    "moving": Case(8.0, plan=(Step(0.0, aim="r"), Step(2.0, pose={"theta1": 27.0, "L2": 1200.0}))),
    "station-faults": Case(
        16.0,
        faults="bad_check@2,dropped_ack@3,joined_buffers@4,clutter@5,lock_loss@7:seconds=3",
    ),
    "prism-jump": Case(8.0, faults="prism_jump@4:to=w", prism="r"),
    "node-faults": Case(
        14.0,
        faults="node_silent@3:node=33:seconds=4,emergency@4:node=34,emergency_clear@6:node=34,"
        "alarm@7:node=35:seconds=2,warning@7:node=36,node_reboot@10:node=37",
    ),
    "preset-jump": Case(7.0, faults="preset_jump@4:node=32:counts=2000"),
    "machine-signals": Case(6.0, faults="counter_gap@3:count=3,not_available@4:seconds=1"),
    "bus-errors": Case(
        6.0,
        faults="bus_error@2:state=warning,bus_error@3:state=passive,bus_error@4:state=bus_off,bus_error@5:state=active",
    ),
    "listening-only": Case(6.0, station=StationSettings(profile="topcon_gts8", push_interval_s=0.5), host=False),
    "classic-pushed": Case(6.0, station=StationSettings(profile="topcon_classic", push_interval_s=1.0), host=False),
    "sokkia-pushed": Case(6.0, station=StationSettings(profile="sokkia_set", push_interval_s=0.5), host=False),
}


def write_case(name: str, case: Case) -> None:
    """Write one simulated case's folder."""
    folder = SIMULATED / name
    folder.mkdir(exist_ok=True)
    settings = SimulatorSettings(
        bus_master="host" if case.host else "machine", sync_period_s=0.2, signal_period_s=0.1, station=case.station
    )
    simulator = RigSimulator(RigTruth(shipped_rig("swdt82"), 7), 7, settings, faults=parse_faults(case.faults))
    host = ScriptedHost(NODES, sync_period_s=0.2, poll_period_s=0.25) if case.host else ScriptedHost()
    captures = generate(simulator, host, case.duration_s, ManualClock(), plan=case.plan).captures
    frames = [c for c in captures if isinstance(c, CanCapture)]
    for suffix in case.formats:
        write_can_log(folder / f"boom.{suffix}", frames)
    profile = case.station.profile if case.host else "passive"
    with (folder / "station.serial").open("w", encoding="utf-8", newline="\n") as stream:
        writer = SerialLogWriter(stream, SerialLogHeader("station", case.station.baud, profile))
        for capture in captures:
            if isinstance(capture, SerialCapture):
                writer.write(capture)
    options = 'listen_to = "sokkia"\n' if case.station.profile == "sokkia_set" else ""
    (folder / "rigcal.toml").write_text(CONFIG.format(profile=profile, options=options), encoding="utf-8")
    replay(folder, folder / "readings.jsonl")


def can_logs(folder: Path) -> list[str]:
    """Return the formats of a case's CAN log; [] for a case of a station alone."""
    return [suffix for suffix in CAN_SUFFIXES if (folder / f"boom.{suffix}").is_file()]


def replay(folder: Path, readings: Path, can_format: str = "log") -> None:
    """Replay a case, as `rigcal replay` does, and write what it yields.

    Args:
        folder: the case; it has a CAN log, a serial log, or both.
        readings: the file to write.
        can_format: which of its CAN logs to take.
    """
    store = readings.with_name(f"{readings.stem}-{can_format}.sqlite")
    files = [str(log) for log in (folder / f"boom.{can_format}", folder / "station.serial") if log.is_file()]
    options = ["--config", str(folder / "rigcal.toml"), "--store", str(store), "--readings", str(readings)]
    prism = CASES[folder.name].prism if folder.parent == SIMULATED else ""
    options += ["--prism", prism] if prism else []
    result = CliRunner().invoke(main, ["replay", *files, *options], catch_exceptions=False)
    for file in store.parent.glob(f"{store.name}*"):
        file.unlink()
    if result.exit_code != 0:
        raise RuntimeError(result.output)


if __name__ == "__main__":
    for wanted in sys.argv[1:] or [f"simulated/{name}" for name in CASES]:
        kind, _, case_name = wanted.partition("/")
        if kind == "simulated" and case_name in CASES:
            write_case(case_name, CASES[case_name])
        elif kind == "real" and (REAL / case_name / "SOURCE.md").is_file():
            replay(REAL / case_name, REAL / case_name / "readings.jsonl")
        else:
            sys.exit(f"{wanted}: no such case; give simulated/NAME or real/NAME")
        print(wanted)
