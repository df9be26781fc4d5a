"""The whole rig in process: what a listener on both links records."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from calibration.rig.description import Rig, parse_rig, shipped_rig
from drivers.clock import ManualClock
from drivers.readings import CanCapture, SerialCapture
from simulators.devices.stations.topcon_text import checked, from_dms
from simulators.devices.stations.total_station import StationSettings
from simulators.faults import parse_faults
from simulators.rig.truth import RigTruth
from simulators.rig_simulator import RigSimulator, SimulatorSettings
from tests.simulated.captures import Generated, Step, generate
from tests.simulated.scripted_host import ScriptedHost


def record(
    rig: Rig, seconds: float = 10.0, *, faults: str = "", host: ScriptedHost | None = None, **settings: object
) -> Generated:
    simulator = RigSimulator(
        RigTruth(rig, 1), 1, SimulatorSettings(signal_period_s=0.05, **settings), faults=parse_faults(faults)
    )
    plan = [Step(0.0, aim="r"), Step(2.0, pose={"theta4": 20.0, "L2": 500.0})]
    return generate(
        simulator, host or ScriptedHost(poll_period_s=0.2), seconds, ManualClock(), plan=plan if rig.channels else ()
    )


def can_of(generated: Generated, identifier: int) -> list[CanCapture]:
    return [c for c in generated.captures if isinstance(c, CanCapture) and c.arbitration_id == identifier]


def records_of(generated: Generated) -> list[tuple[float, bytes]]:
    """(seconds, data) of every good block from the station."""
    out, buffer = [], b""
    start = generated.captures[0].stamp.monotonic_ns
    for c in generated.captures:
        if isinstance(c, SerialCapture) and not c.is_transmitted:
            buffer += c.data
            *blocks, buffer = buffer.split(b"\x03")
            for block in blocks:
                data = checked(block.strip(b"\r\n"))
                if data is not None:
                    out.append(((c.stamp.monotonic_ns - start) / 1e9, data))
    return out


@pytest.fixture(scope="module")
def quiet() -> Generated:
    return record(shipped_rig("swdt82"))


def test_the_same_arguments_give_the_same_captures(quiet: Generated) -> None:
    assert record(shipped_rig("swdt82")) == quiet


def test_stamps_rise_and_no_two_frames_share_the_bus(quiet: Generated) -> None:
    stamps = [c.stamp.monotonic_ns for c in quiet.captures]
    assert stamps == sorted(stamps)
    frames = [c.stamp.monotonic_ns for c in quiet.captures if isinstance(c, CanCapture)]
    assert min(np.diff(frames)) >= 47 / 500_000 * 1e9


def test_a_node_may_be_commissioned_to_send_its_warnings_beside_the_position() -> None:
    words = (0x60040020, 0x65030010, 0x65050010)
    generated = record(shipped_rig("swdt82"), 4.0, faults="warning@2:node=38:bits=16", mappings={38: words})
    sent = [capture.data for capture in can_of(generated, 0x180 + 38)]
    assert {len(data) for data in sent} == {8}
    assert [data[4:] for data in sent[:: len(sent) - 1]] == [bytes(4), b"\x00\x00\x10\x00"]
    assert {len(capture.data) for capture in can_of(generated, 0x180 + 37)} == {4}


def test_all_nodes_boot_are_started_and_answer_every_sync(quiet: Generated) -> None:
    syncs = len(can_of(quiet, 0x080))
    assert syncs == pytest.approx(200, abs=2)
    for node in (*range(32, 39), 48, 49, 50):
        assert can_of(quiet, 0x700 + node)[0].data == b"\x00"
        assert len(can_of(quiet, 0x180 + node)) == pytest.approx(syncs - 6, abs=2)
        assert len(can_of(quiet, 0x280 + node)) == 0
    assert len(can_of(quiet, 0x1BC)) == pytest.approx(97, abs=3)  # the pressure transmitter: 100 ms, by its own timer
    assert len(can_of(quiet, 0x200)) == len(can_of(quiet, 0x201)) == pytest.approx(200, abs=2)
    assert not any(c.is_transmitted for c in quiet.captures if isinstance(c, CanCapture))


def test_encoder_counts_follow_the_motion(quiet: Generated) -> None:
    counts = [int.from_bytes(c.data, "little") for c in can_of(quiet, 0x180 + 34)]
    degrees = [(c - 20000) * 360 / 65536 for c in counts]
    assert degrees[0] == pytest.approx(22.5, abs=0.05)  # the middle of theta4's limits
    assert degrees[-1] == pytest.approx(20.0, abs=0.05)
    strokes = [int.from_bytes(c.data, "little", signed=True) / 10 for c in can_of(quiet, 0x180 + 48)]
    assert strokes[0] == pytest.approx(1084.0, abs=1)
    assert strokes[-1] == pytest.approx(500.0, abs=1)
    assert ("arrived", {"theta4": 20.0, "L2": 500.0}) in [(e["event"], e.get("pose")) for _, e in quiet.events]


def test_fixes_are_where_the_truth_has_the_prism(quiet: Generated) -> None:
    truth = RigTruth(shipped_rig("swdt82"), 1)
    pose = {j.name: np.array([sum(j.limits) / 2]) for j in truth.rig.joints}
    moved = pose | {"theta4": np.array([20.0]), "L2": np.array([500.0])}
    records = [(t, data) for t, data in records_of(quiet) if data.startswith(b"Q") and data[54:55] == b"1"]
    assert len(records) > 20
    for (t, data), joints in ((records[0], pose), (records[-1], moved)):
        slope, zenith, hz = int(data[1:11]) / 10, from_dms(data[12:20].decode()), from_dms(data[20:29].decode())
        V, H = np.deg2rad(zenith), np.deg2rad(hz)
        got = slope * np.array([np.sin(V) * np.sin(H), np.sin(V) * np.cos(H), np.cos(V)])
        assert np.linalg.norm(got - truth.prism_mm("r", joints)[0]) < 15.0, t


def test_nodes_from_the_factory_stay_silent_until_the_host_has_set_them_up() -> None:
    rig = shipped_rig("swdt82")
    silent = record(rig, 5.0, bus_master="host", host=ScriptedHost())
    assert {c.arbitration_id for c in silent.captures if isinstance(c, CanCapture)} == {
        *(0x700 + n for n in (*range(32, 39), 48, 49, 50, 60)),
        0x200,
        0x201,
    }
    nodes = (*range(32, 39), 48, 49, 50, 60)
    ready = record(rig, 5.0, bus_master="host", host=ScriptedHost(nodes, sync_period_s=0.1))
    answers = [c for c in ready.captures if isinstance(c, CanCapture) and c.arbitration_id & ~0x7F == 0x580]
    assert len(answers) == 8 * len(nodes)
    refused = [c for c in answers if c.data[0] == 0x80]
    assert [(c.arbitration_id, c.data[1:3].hex()) for c in refused] == [(0x5BC, "0165")]  # no 6501h in CiA 404
    for node in nodes:
        assert len(can_of(ready, 0x180 + node)) > 40
        assert can_of(ready, 0x700 + node)[-1].data == b"\x05"
    assert {c.arbitration_id for c in ready.captures if isinstance(c, CanCapture) and c.is_transmitted} == {
        0x000,
        0x080,
        *(0x600 + n for n in nodes),
    }


class TestFaults:
    def test_a_silent_node_leaves_a_hole_and_comes_back(self) -> None:
        got = record(shipped_rig("swdt82"), faults="node_silent@4:node=33:seconds=2")
        times = [c.stamp.monotonic_ns / 1e9 - 1 for c in can_of(got, 0x1A1)]
        assert max(np.diff(times)) == pytest.approx(2.0, abs=0.11)
        assert {e["kind"] for _, e in got.events if e["event"] == "fault"} == {"node_silent"}

    def test_a_rebooted_node_boots_up_and_is_started_again(self) -> None:
        got = record(shipped_rig("swdt82"), faults="node_reboot@4:node=33")
        assert [c.data for c in can_of(got, 0x721)].count(b"\x00") == 2
        assert can_of(got, 0x721)[-1].data == b"\x05"

    def test_emergencies_alarms_and_jumps(self) -> None:
        got = record(
            shipped_rig("swdt82"),
            faults="emergency@3:node=33,emergency_clear@4:node=33,alarm@5:node=34:seconds=1,preset_jump@6:node=35:counts=500",
        )
        assert [c.data[:3].hex() for c in can_of(got, 0x0A1)] == ["005081", "000000"]
        alarms = can_of(got, 0x0A2)
        assert [c.data[:2].hex() for c in alarms] == ["0050", "0000"]
        assert (alarms[1].stamp.monotonic_ns - alarms[0].stamp.monotonic_ns) / 1e9 == pytest.approx(1.0, abs=0.01)
        counts = [int.from_bytes(c.data, "little") for c in can_of(got, 0x1A3)]
        assert max(np.diff(counts)) == pytest.approx(500, abs=10)

    def test_a_warning_is_in_the_nodes_objects(self) -> None:
        simulator = RigSimulator(RigTruth(shipped_rig("swdt82"), 1), 1, faults=parse_faults("warning@1:node=34"))
        simulator.poll(2.0)
        node = next(n for n in simulator.nodes if n.node == 34)
        assert node.dictionary.read(0x6505, 0) == b"\x10\x00"

    def test_machine_signals(self) -> None:
        got = record(shipped_rig("swdt82"), faults="counter_gap@3:count=3,not_available@4:seconds=1")
        frames = can_of(got, 0x201)
        counters = np.array([f.data[7] & 15 for f in frames])
        steps = Counter((np.diff(counters) % 16).tolist())
        assert steps[4] == 1
        assert set(steps) == {1, 4}
        assert sum(f.data[:7] == b"\xff" * 7 for f in frames) == pytest.approx(20, abs=2)

    def test_error_frames(self) -> None:
        got = record(
            shipped_rig("swdt82"),
            faults=",".join(
                f"bus_error@3:state={s}" for s in ("warning", "passive", "bus_off", "active", "acknowledge")
            ),
        )
        errors = [c for c in got.captures if isinstance(c, CanCapture) and c.is_error]
        assert [(e.arbitration_id, e.data[1]) for e in errors] == [(4, 4), (4, 0x10), (0x40, 0), (4, 0x40), (0x20, 0)]

    def test_the_station_loses_its_lock_and_finds_the_prism_again(self) -> None:
        got = record(shipped_rig("swdt82"), 20.0, faults="lock_loss@5:seconds=4")
        flags = "".join(dict.fromkeys(data[54:55].decode() for _, data in records_of(got) if data.startswith(b"Q")))
        assert flags == "4132"  # turning to the prism, then lock, wait, search
        assert records_of(got)[-1][1][54:55] == b"1"

    def test_the_station_follows_another_prism(self) -> None:
        got = record(shipped_rig("swdt82"), faults="prism_jump@6:to=s")
        slopes = [int(data[1:11]) / 10 for _, data in records_of(got) if data.startswith(b"Q")]
        assert max(abs(np.diff(slopes))) > 100

    def test_faults_on_the_line(self) -> None:
        got = record(
            shipped_rig("swdt82"), 20.0, faults="bad_check@3,dropped_ack@5,joined_buffers@7,clutter@9,station_silent@11"
        )
        text = b"".join(c.data for c in got.captures if isinstance(c, SerialCapture) and not c.is_transmitted)
        assert b"\n006Q" in text
        blocks = [b.strip(b"\r\n") for b in text.split(b"\x03")][:-1]
        assert sum(checked(b) is None for b in blocks) == 3  # bad check, joined, clutter
        times = [t for t, _ in records_of(got)]
        assert max(np.diff(times)) >= 5.0

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("node_silent@1:node=99", "this rig has no node 99; nodes: 32, 33"),
            ("prism_jump@1:to=q", "no prism 'q'; this rig has w, b, r, s"),
            ("preset_jump@1:node=60", "node 60 is not an encoder or length transducer"),
        ],
    )
    def test_a_fault_of_a_part_that_is_not_there_is_refused_at_once(self, text: str, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            record(shipped_rig("swdt82"), faults=text)

    def test_a_rig_without_channels_has_only_a_station(self) -> None:
        rig = shipped_rig("ur10")
        got = record(rig, 3.0)
        assert all(isinstance(c, SerialCapture) for c in got.captures)
        with pytest.raises(ValueError, match="no machine signals"):
            record(rig, faults="counter_gap@1")
        with pytest.raises(ValueError, match="nodes: none"):
            record(rig, faults="node_reboot@1")


@pytest.mark.parametrize("profile", ["topcon_classic", "sokkia_set"])
def test_other_stations_push_what_the_operator_points_at(profile: str) -> None:
    settings = StationSettings(profile=profile, push_interval_s=0.5)
    got = record(shipped_rig("swdt82"), 5.0, host=ScriptedHost(), station=settings)
    assert not any(c.is_transmitted for c in got.captures)
    assert sum(c.data.count(b"\n") for c in got.captures if isinstance(c, SerialCapture)) >= 8


def test_joints_may_come_in_raw_frames(odd_rig_text: str) -> None:
    channels = """
[[channel]]
name = "lift"
device = "raw"
unit = "deg"
arbitration_id = 0x310
start_bit = 0
length_bits = 16
is_signed = true
scale = 0.01
"""
    rig = parse_rig(odd_rig_text.format(convention="dh") + channels, "odd.toml")
    got = generate(RigSimulator(RigTruth(rig, 1), 1), ScriptedHost(), 2.0, ManualClock())
    values = [int.from_bytes(c.data[:2], "little", signed=True) / 100 for c in can_of(got, 0x310)]
    assert len(values) >= 98
    assert values[0] == pytest.approx(10.0, abs=0.1)


def test_a_machine_of_another_dbc_is_refused(odd_rig_text: str) -> None:
    channel = '[[channel]]\nname = "p"\ndevice = "dbc"\nunit = "bar"\ndbc = "x.dbc"\nmessage = "M"\nsignal = "S"\n'
    rig = parse_rig(odd_rig_text.format(convention="dh") + channel, "odd.toml")
    with pytest.raises(ValueError, match=r"channel p: the simulated machine only sends machine.dbc, not x.dbc"):
        RigSimulator(RigTruth(rig, 1), 1)
