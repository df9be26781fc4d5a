"""The machine's frames, read by cantools from the DBC that ships: a reader that the simulator has no part in."""

from __future__ import annotations

from importlib import resources

import cantools
import numpy as np
import pytest

from calibration.rig.channels import RawSignal
from simulators.devices.can.machine_signals import MachineSignals, MachineState
from simulators.devices.can.raw_signals import RawSignals, pack

DBC = cantools.database.load_string(
    resources.files("calibration").joinpath("rigs", "machine.dbc").read_text(encoding="ascii"), "dbc"
)


def signals(speeds: dict[str, float], load_bar: float = 100.0) -> MachineSignals:
    return MachineSignals(lambda _: MachineState(speeds, load_bar), np.random.default_rng(0))


def decoded(sender: MachineSignals, now_s: float) -> dict[str, float]:
    out: dict[str, float] = {}
    for frame in sender.poll(now_s):
        out |= DBC.decode_message(frame.arbitration_id, frame.data)
    return out


def test_currents_follow_direction_and_speed() -> None:
    got = decoded(signals({"boom": 0.25, "arm": -1.0, "slew": 1.0}), 0.0)
    assert got["VC_Boom_mA"] == pytest.approx(180 + 0.25 * 570, abs=20)
    assert got["VC_Arm_mA"] == pytest.approx(-750, abs=20)
    assert got["VC_Slew_mA"] == pytest.approx(750, abs=20)
    assert got["VC_Bucket_mA"] == 0


def test_pressures_follow_load_and_motion_and_the_oil_warms() -> None:
    still, moving = decoded(signals({}), 0.0), decoded(signals({"boom": -1.0}, 150.0), 0.0)
    assert still["P_Pump_bar"] == pytest.approx(22, abs=2)
    assert moving["P_Pump_bar"] > 150
    assert still["P_BoomA_bar"] == pytest.approx(100, abs=2)
    assert moving["P_BoomA_bar"] == pytest.approx(150, abs=2)
    assert moving["P_BoomB_bar"] > still["P_BoomB_bar"] + 30
    assert still["OilTemp_C"] == 38
    assert decoded(signals({}), 3600.0)["OilTemp_C"] > 50


def test_the_worked_frame_of_pressures_has_this_layout() -> None:
    """235.4 / 181.2 / 12.0 bar, 52 degC, counter 5 -> 32 09 14 07 78 00 5C 05, and the four currents likewise."""

    class Silent:
        def normal(self, *_: float) -> float:
            return 0.0

    frames = signals({}, 181.2)
    frames._rng = Silent()
    frames._counter = 5
    data = frames.poll(0.0)[1].data
    assert data[2:4] == bytes.fromhex("1407")
    assert data[4:6] == bytes.fromhex("7800")
    assert data[7] == 5


def test_frames_come_every_ten_milliseconds_and_the_counter_counts() -> None:
    sender = signals({})
    counters = [decoded(sender, sender.next_deadline())["MsgCounter"] for _ in range(20)]
    assert counters == [i % 16 for i in range(20)]
    assert sender.next_deadline() == pytest.approx(0.2)
    assert sender.poll(0.1) == []


def test_a_counter_gap_shows_how_many_are_missing() -> None:
    sender = signals({})
    before = decoded(sender, 0.0)["MsgCounter"]
    sender.skip_frames(3)
    assert decoded(sender, 0.01)["MsgCounter"] == before + 4


def test_values_that_are_not_available_are_all_ones() -> None:
    sender = signals({})
    sender.void(1.0)
    frame = sender.poll(0.0)[1]
    assert frame.data[:7] == b"\xff" * 7
    assert sender.poll(1.0)[1].data[:2] != b"\xff\xff"


def raw(**more: object) -> RawSignal:
    return RawSignal.model_validate(
        {"device": "raw", "name": "x", "unit": "mm", "arbitration_id": 0x300, "start_bit": 0, "length_bits": 16} | more
    )


@pytest.mark.parametrize("byte_order", ["intel", "motorola"])
@pytest.mark.parametrize(("start_bit", "length"), [(0, 8), (7, 12), (15, 16), (23, 9), (39, 24)])
@pytest.mark.parametrize("value", [0.0, 1.0, 37.0, -1.0, -60.0])
def test_a_raw_signal_is_packed_as_cantools_would(byte_order: str, start_bit: int, length: int, value: float) -> None:
    channel = raw(start_bit=start_bit, length_bits=length, byte_order=byte_order, is_signed=True, scale=0.5, offset=3.0)
    signal = cantools.database.can.Signal(
        "x",
        start_bit,
        length,
        "little_endian" if byte_order == "intel" else "big_endian",
        is_signed=True,
        conversion=cantools.database.conversion.BaseConversion.factory(scale=0.5, offset=3.0),
    )
    message = cantools.database.can.Message(0x300, "m", 8, [signal], strict=True)
    assert message.decode(pack(channel, value)) == {"x": value}


def test_what_does_not_fit_is_clipped() -> None:
    assert pack(raw(length_bits=8), 1000.0) == bytes([255, 0, 0, 0, 0, 0, 0, 0])
    assert pack(raw(length_bits=8), -5.0) == bytes(8)
    assert pack(raw(length_bits=8, is_signed=True), -1000.0) == bytes([0x80, 0, 0, 0, 0, 0, 0, 0])


def test_raw_signals_of_one_frame_share_it() -> None:
    channels = [raw(), raw(name="y", start_bit=16), raw(name="z", arbitration_id=0x18FF0001, is_extended=True)]
    sender = RawSignals(channels, {n: lambda _, v=v: (v, 0.0) for n, v in (("x", 1.0), ("y", 2.0), ("z", 3.0))})
    frames = sender.poll(0.0)
    assert [(x.arbitration_id, x.data[:4].hex(), x.is_extended) for x in frames] == [
        (0x300, "01000200", False),
        (0x18FF0001, "03000000", True),
    ]
    assert sender.poll(0.01) == []
    assert sender.next_deadline() == pytest.approx(0.02)
