"""Simulated CANopen nodes, from the device's side: conversations as lists of (sent, received)."""

from __future__ import annotations

import struct
import threading
import uuid
from collections.abc import Iterator

import can
import canopen
import pytest

from calibration.rig.channels import Cia404Analogue, Cia406Encoder, Cia406Linear
from simulators.devices.can.bus import Frame
from simulators.devices.can.node import CanopenNode, NmtState
from simulators.devices.can.profiles import EncoderNode, LinearNode, PressureNode, encoder_of, linear_of, pressure_of


def f(text: str) -> Frame:
    """`1A0 4E 61` as a frame."""
    head, *data = text.split()
    return Frame(int(head, 16), bytes.fromhex("".join(data)))


def shown(frames: list[Frame]) -> list[str]:
    return [" ".join([f"{x.arbitration_id:03X}", *(f"{b:02X}" for b in x.data)]) for x in frames]


def booted(node: CanopenNode) -> CanopenNode:
    node.power_on(0.0)
    boot = node.next_deadline()
    assert shown(node.poll(boot)) == [f"{0x700 + node.node:03X} 00"]
    return node


def converse(node: CanopenNode, conversation: list[tuple[str, str]], now_s: float = 1.0) -> None:
    for sent, received in conversation:
        answers = node.receive(f(sent), now_s)
        assert shown(answers) == ([received] if received else []), sent


def turns(value: float, rate: float = 0.0):
    return lambda now_s: (value + rate * now_s, rate)


def position_node(position: int, **more: int) -> EncoderNode:
    """A 13 bit x 12 bit encoder that stands at a position in units."""
    return EncoderNode(
        more.pop("node", 32),
        turns(position / 8192),
        steps_per_turn=8192,
        revolutions=4096,
        units_per_revolution=8192,
        total_units=8192 * 4096,
        **more,
    )


class TestSdo:
    def test_a_position_is_read_as_in_the_manuals_example(self) -> None:
        node = booted(position_node(12345678))
        converse(node, [("620 40 04 60 00 00 00 00 00", "5A0 43 04 60 00 4E 61 BC 00")])

    def test_an_unknown_object_is_refused_as_in_the_example(self) -> None:
        node = booted(position_node(0))
        converse(node, [("620 40 54 76 00 00 00 00 00", "5A0 80 54 76 00 00 00 02 06")])

    def test_the_worked_frames_with_command_22_are_accepted(self) -> None:
        """Preset 7200, then 100 ms cyclic, node 0Bh; node number 0Bh and 500 kbit/s from the factory's node 32."""
        node = booted(position_node(500, node=0x0B))
        converse(
            node,
            [
                ("60B 22 03 60 00 20 1C 00 00", "58B 60 03 60 00 00 00 00 00"),
                ("60B 40 04 60 00 00 00 00 00", "58B 43 04 60 00 20 1C 00 00"),
                ("60B 22 00 18 05 64 00 00 00", "58B 60 00 18 05 00 00 00 00"),
                ("60B 40 00 62 00 00 00 00 00", "58B 4B 00 62 00 64 00 00 00"),
            ],
        )
        factory = booted(position_node(0))
        converse(
            factory,
            [
                ("620 22 00 30 00 0A 00 00 00", "5A0 60 00 30 00 00 00 00 00"),
                ("620 22 01 30 00 05 00 00 00", "5A0 60 01 30 00 00 00 00 00"),
            ],
        )

    @pytest.mark.parametrize(
        ("request_", "code"),
        [
            ("620 2B 03 60 00 20 1C 00 00", "06 07 00 13"),  # two bytes where four are due: too short
            ("620 23 00 62 00 64 00 00 00", "06 07 00 12"),  # four where two are due: too long
            ("620 23 04 60 00 64 00 00 00", "06 01 00 02"),  # read only
            ("620 40 00 23 00 00 00 00 00", "06 01 00 01"),  # write only
            ("620 40 18 10 09 00 00 00 00", "06 09 00 11"),  # no such sub-index
            ("620 23 01 60 00 00 00 00 00", "06 09 00 30"),  # value out of range
            ("620 23 10 10 01 73 61 76 00", "08 00 00 20"),  # wrong signature
            ("620 23 11 10 01 6C 6F 61 65", "08 00 00 20"),
            ("620 23 00 23 00 55 AA AA 54", "08 00 00 20"),
            ("620 21 03 60 00 04 00 00 00", "05 04 00 01"),  # segmented download is not offered
            ("620 60 00 00 00 00 00 00 00", "05 04 00 01"),  # a segment without a beginning
            ("620 A0 04 60 00 00 00 00 00", "05 04 00 01"),  # block transfer
        ],
    )
    def test_what_is_not_allowed_is_refused_with_its_abort_code(self, request_: str, code: str) -> None:
        node = booted(position_node(0))
        (answer,) = node.receive(f(request_), 1.0)
        assert answer.data[0] == 0x80
        assert answer.data[4:] == bytes.fromhex(code.replace(" ", ""))[::-1]

    def test_a_name_longer_than_four_bytes_comes_in_segments(self) -> None:
        node = booted(position_node(0))
        converse(
            node,
            [
                ("620 40 08 10 00 00 00 00 00", "5A0 41 08 10 00 0A 00 00 00"),
                ("620 60 00 00 00 00 00 00 00", "5A0 00 53 49 4D 2D 43 49 41"),
                ("620 70 00 00 00 00 00 00 00", "5A0 19 34 30 36 00 00 00 00"),
            ],
        )

    def test_a_wrong_toggle_bit_ends_the_transfer(self) -> None:
        node = booted(position_node(0))
        converse(
            node,
            [
                ("620 40 08 10 00 00 00 00 00", "5A0 41 08 10 00 0A 00 00 00"),
                ("620 70 00 00 00 00 00 00 00", "5A0 80 08 10 00 00 00 03 05"),
                ("620 60 00 00 00 00 00 00 00", "5A0 80 00 00 00 01 00 04 05"),
            ],
        )

    def test_a_clients_abort_and_malformed_requests_are_met_with_silence(self) -> None:
        node = booted(position_node(0))
        converse(node, [("620 80 08 10 00 00 00 03 05", ""), ("620 40 08", ""), ("621 40 00 10 00 00 00 00 00", "")])

    def test_preset_is_checked_against_the_range(self) -> None:
        node = booted(position_node(0))
        converse(node, [("620 23 03 60 00 00 00 00 02", "5A0 80 03 60 00 31 00 09 06")])


class TestNmt:
    def test_a_node_is_silent_until_it_is_set_up_and_started(self) -> None:
        node = booted(position_node(100))
        assert node.next_deadline() == float("inf")
        converse(node, [("080", ""), ("000 01 21", "")])  # SYNC; start of another node
        assert node.state is NmtState.PRE_OPERATIONAL
        converse(node, [("000 01 20", "")])
        assert node.state is NmtState.OPERATIONAL
        assert node.next_deadline() == float("inf")  # TPDO1's event timer is 0
        converse(node, [("080", "2A0 64 00 00 00")])  # TPDO2 answers every SYNC

    def test_start_stop_and_broadcast(self) -> None:
        node = booted(position_node(0))
        for command, state in (("01", 5), ("80", 0x7F), ("02", 4), ("01", 5)):
            node.receive(f(f"000 {command} 00"), 1.0)
            assert node.state == state
        node.receive(f("000 02 20"), 1.0)
        converse(node, [("620 40 04 60 00 00 00 00 00", "")])  # a stopped node answers no SDO

    @pytest.mark.parametrize("command", ["81", "82"])
    def test_a_reset_boots_again(self, command: str) -> None:
        node = booted(position_node(0))
        converse(node, [("620 2B 17 10 00 64 00 00 00", "5A0 60 17 10 00 00 00 00 00"), (f"000 {command} 20", "")])
        assert node.state is NmtState.BOOT_UP
        assert shown(node.poll(2.0)) == ["720 00"]
        assert node.next_deadline() == float("inf")  # the heartbeat was not stored

    def test_heartbeats_carry_the_state(self) -> None:
        node = booted(position_node(0))
        node.receive(f("620 2B 17 10 00 F4 01 00 00"), 1.0)
        assert node.next_deadline() == pytest.approx(1.5)
        assert shown(node.poll(1.5)) == ["720 7F"]
        node.receive(f("000 01 20"), 1.6)
        assert shown(node.poll(2.0)) == ["720 05"]

    def test_the_node_number_counts_after_save_and_reset_and_is_the_value_plus_one(self) -> None:
        node = booted(position_node(0))
        converse(
            node,
            [
                ("620 22 00 30 00 0A 00 00 00", "5A0 60 00 30 00 00 00 00 00"),
                ("620 40 00 30 00 00 00 00 00", "5A0 4F 00 30 00 0A 00 00 00"),
                ("620 22 00 23 00 55 AA AA 55", "5A0 60 00 23 00 00 00 00 00"),
            ],
        )
        assert shown(node.poll(node.next_deadline())) == ["70B 00"]
        node.receive(f("000 01 0B"), 3.0)
        converse(node, [("080", "28B 00 00 00 00"), ("60B 40 00 18 01 00 00 00 00", "58B 43 00 18 01 8B 01 00 00")])

    def test_an_unsaved_change_is_lost_with_the_power_and_a_saved_one_is_not(self) -> None:
        node = booted(position_node(500))
        node.receive(f("620 23 03 60 00 E8 03 00 00"), 1.0)  # preset 1000
        node.receive(f("620 22 00 18 05 64 00 00 00"), 1.0)
        node.power_on(2.0)
        node.poll(3.0)
        converse(node, [("620 40 04 60 00 00 00 00 00", "5A0 43 04 60 00 F4 01 00 00")], 3.0)
        node.receive(f("620 23 03 60 00 E8 03 00 00"), 3.0)
        converse(node, [("620 23 10 10 01 73 61 76 65", "5A0 60 10 10 01 00 00 00 00")])
        node.power_on(4.0)
        node.poll(5.0)
        converse(node, [("620 40 04 60 00 00 00 00 00", "5A0 43 04 60 00 E8 03 00 00")], 5.0)

    def test_load_brings_the_factorys_values_back_after_the_next_reset(self) -> None:
        node = booted(position_node(0))
        node.receive(f("620 2B 17 10 00 F4 01 00 00"), 1.0)
        node.receive(f("620 23 10 10 01 73 61 76 65"), 1.0)
        converse(node, [("620 23 11 10 01 6C 6F 61 64", "5A0 60 11 10 01 00 00 00 00")])
        converse(node, [("620 40 17 10 00 00 00 00 00", "5A0 4B 17 10 00 F4 01 00 00")])
        node.power_on(4.0)
        node.poll(5.0)
        converse(node, [("620 40 17 10 00 00 00 00 00", "5A0 4B 17 10 00 00 00 00 00")], 5.0)


class TestPdo:
    def operational(self, node: CanopenNode) -> CanopenNode:
        booted(node).receive(f(f"000 01 {node.node:02X}"), 1.0)
        return node

    def test_the_event_timer_sends_the_worked_position(self) -> None:
        node = self.operational(position_node(12345678))
        node.receive(f("620 22 00 18 05 64 00 00 00"), 1.0)
        assert node.next_deadline() == pytest.approx(1.1)
        assert shown(node.poll(1.1)) == ["1A0 4E 61 BC 00"]
        assert node.next_deadline() == pytest.approx(1.2)
        assert len(node.poll(9.0)) == 1  # no burst for what was missed

    def test_6200_and_2200_are_the_same_timer(self) -> None:
        node = self.operational(position_node(1))
        for alias in ("00 62", "00 22"):
            node.receive(f(f"620 22 {alias} 00 32 00 00 00"), 1.0)
            assert node.next_deadline() == pytest.approx(1.05)
            node.receive(f(f"620 22 {alias} 00 00 00 00 00"), 1.0)
            assert node.next_deadline() == float("inf")

    def test_a_valid_pdo_refuses_changes_until_bit_31_is_set(self) -> None:
        node = self.operational(position_node(7))
        refused = "5A0 80 {} 22 00 00 08"
        converse(
            node,
            [
                ("620 2F 00 18 02 01 00 00 00", refused.format("00 18 02")),
                ("620 2B 00 18 03 01 00 00 00", refused.format("00 18 03")),
                ("620 2F 00 1A 00 00 00 00 00", refused.format("00 1A 00")),
                ("620 23 00 18 01 91 01 00 00", refused.format("00 18 01")),
                ("620 23 00 18 01 A0 01 00 80", "5A0 60 00 18 01 00 00 00 00"),
                ("620 2F 00 18 02 02 00 00 00", "5A0 60 00 18 02 00 00 00 00"),
                ("620 2F 00 18 02 F5 00 00 00", "5A0 80 00 18 02 30 00 09 06"),
                ("080", "2A0 07 00 00 00"),  # only TPDO2: TPDO1 is switched off
                ("620 23 00 18 01 A0 01 00 00", "5A0 60 00 18 01 00 00 00 00"),
                ("080", "2A0 07 00 00 00"),
            ],
        )
        assert shown(node.receive(f("080"), 2.0)) == ["1A0 07 00 00 00", "2A0 07 00 00 00"]  # every second SYNC

    def test_remapping_needs_the_count_at_zero_and_mappable_objects_of_the_right_length(self) -> None:
        node = self.operational(position_node(7))
        done = "5A0 60 {} 00 00 00 00"
        converse(
            node,
            [
                ("620 23 00 18 01 A0 01 00 80", done.format("00 18 01")),
                ("620 23 00 1A 02 10 01 30 60", "5A0 80 00 1A 02 22 00 00 08"),
                ("620 2F 00 1A 00 00 00 00 00", done.format("00 1A 00")),
                ("620 23 00 1A 01 20 00 01 60", "5A0 80 00 1A 01 41 00 04 06"),  # 6001h is not for PDOs
                ("620 23 00 1A 01 10 00 04 60", "5A0 80 00 1A 01 41 00 04 06"),  # 16 bits of 32
                ("620 23 00 1A 01 20 00 99 60", "5A0 80 00 1A 01 00 00 02 06"),  # no such object
                ("620 23 00 1A 01 20 00 04 60", done.format("00 1A 01")),
                ("620 23 00 1A 02 10 01 30 60", done.format("00 1A 02")),
                ("620 23 00 1A 03 10 00 03 65", done.format("00 1A 03")),
                ("620 23 00 1A 04 10 00 05 65", done.format("00 1A 04")),
                ("620 2F 00 1A 00 05 00 00 00", "5A0 80 00 1A 00 31 00 09 06"),
                ("620 2F 00 1A 00 03 00 00 00", done.format("00 1A 00")),
                ("620 2F 00 18 02 01 00 00 00", done.format("00 18 02")),
                ("620 23 00 18 01 A0 01 00 00", done.format("00 18 01")),
            ],
        )
        assert shown(node.receive(f("080"), 2.0))[0] == "1A0 07 00 00 00 00 00 00 00"

    def test_a_mapping_longer_than_a_frame_is_refused(self) -> None:
        node = self.operational(position_node(7))
        for request in (
            "620 23 00 18 01 A0 01 00 80",
            "620 2F 00 1A 00 00 00 00 00",
            *(f"620 23 00 1A 0{i} 20 00 04 60" for i in (1, 2, 3)),
        ):
            (answer,) = node.receive(f(request), 1.0)
            assert answer.data[0] == 0x60
        converse(node, [("620 2F 00 1A 00 03 00 00 00", "5A0 80 00 1A 00 42 00 04 06")])

    def test_polled_mode_answers_remote_frames(self) -> None:
        node = self.operational(position_node(9))
        assert shown(node.receive(Frame(0x1A0, b"", is_remote=True), 2.0)) == ["1A0 09 00 00 00"]
        assert node.receive(Frame(0x1A1, b"", is_remote=True), 2.0) == []

    def test_type_252_answers_a_remote_frame_with_what_the_last_sync_sampled(self) -> None:
        node = self.operational(EncoderNode(32, turns(0.0, 1 / 65536)))
        for request in (
            "620 23 00 18 01 A0 01 00 80",
            "620 2F 00 18 02 FC 00 00 00",
            "620 23 00 18 01 A0 01 00 00",
            "620 23 01 18 01 A0 02 00 80",
        ):
            node.receive(f(request), 1.0)
        assert node.receive(f("080"), 5.0) == []
        assert shown(node.receive(Frame(0x1A0, b"", is_remote=True), 9.0)) == ["1A0 05 00 00 00"]
        node.receive(f("620 23 00 18 01 A0 01 00 40"), 9.0)
        assert node.receive(Frame(0x1A0, b"", is_remote=True), 9.0) == []  # bit 30: no remote frames

    def test_the_inhibit_time_holds_the_event_timer_back(self) -> None:
        node = self.operational(position_node(1))
        for request in (
            "620 23 00 18 01 A0 01 00 80",
            "620 2B 00 18 03 10 27 00 00",  # 10,000 x 0.1 ms
            "620 23 00 18 01 A0 01 00 00",
            "620 2B 00 18 05 64 00 00 00",
        ):
            node.receive(f(request), 1.0)
        assert len(node.poll(1.1)) == 1
        assert node.next_deadline() == pytest.approx(2.1)

    def test_type_0_sends_on_sync_only_what_has_changed(self) -> None:
        node = self.operational(EncoderNode(32, turns(0.0, 0.01)))
        for request in (
            "620 23 01 18 01 A0 02 00 80",
            "620 2F 01 18 02 00 00 00 00",
            "620 23 01 18 01 A0 02 00 00",
        ):
            node.receive(f(request), 1.0)
        assert len(node.receive(f("080"), 2.0)) == 1
        assert node.receive(f("080"), 2.0) == []
        assert len(node.receive(f("080"), 3.0)) == 1


class TestErrors:
    def test_an_emergency_has_its_code_its_register_and_a_place_in_the_history(self) -> None:
        node = booted(position_node(0))
        node.emergency(0x5000, 0x81, bytes([1, 2, 3, 4, 5]))
        assert shown(node.poll(1.0)) == ["0A0 00 50 81 01 02 03 04 05"]
        converse(
            node,
            [
                ("620 40 01 10 00 00 00 00 00", "5A0 4F 01 10 00 81 00 00 00"),
                ("620 40 03 10 00 00 00 00 00", "5A0 4F 03 10 00 01 00 00 00"),
                ("620 40 03 10 01 00 00 00 00", "5A0 43 03 10 01 00 50 00 00"),
                ("620 40 03 10 02 00 00 00 00", "5A0 80 03 10 02 11 00 09 06"),
                ("620 2F 03 10 00 01 00 00 00", "5A0 80 03 10 00 30 00 09 06"),
                ("620 2F 03 10 00 00 00 00 00", "5A0 60 03 10 00 00 00 00 00"),
                ("620 40 03 10 00 00 00 00 00", "5A0 4F 03 10 00 00 00 00 00"),
            ],
        )
        node.emergency(0, 0)
        assert shown(node.poll(2.0)) == ["0A0 00 00 00 00 00 00 00 00"]

    def test_an_alarm_is_reported_once_and_its_end_too(self) -> None:
        node = booted(position_node(0))
        for bits in (1, 1, 0):
            node.set_alarm(bits)
        assert shown(node.poll(1.0)) == ["0A0 00 50 81 01 00 00 00 00", "0A0 00 00 00 00 00 00 00 00"]
        node.set_alarm(1)
        node.set_warning(0x10)
        node.poll(1.0)
        converse(
            node,
            [
                ("620 40 03 65 00 00 00 00 00", "5A0 4B 03 65 00 01 00 00 00"),
                ("620 40 05 65 00 00 00 00 00", "5A0 4B 05 65 00 10 00 00 00"),
            ],
        )

    def test_a_muted_node_neither_hears_nor_speaks(self) -> None:
        node = booted(position_node(0))
        node.receive(f("620 2B 17 10 00 64 00 00 00"), 1.0)
        node.mute(2.0)
        assert node.poll(1.5) == []
        converse(node, [("620 40 04 60 00 00 00 00 00", "")], 1.6)
        assert shown(node.poll(2.1)) == ["720 7F"]


class TestProfiles:
    def value(self, node: CanopenNode, index: int, sub: int = 0) -> int:
        return node.dictionary.value(index, sub)

    def test_counts_wrap_at_the_total_range(self) -> None:
        node = booted(EncoderNode(32, turns(-1 / 65536)))
        assert self.value(node, 0x6004) == 65535
        assert self.value(node, 0x1000) == 0x00010196
        assert self.value(node, 0x6502) == 1

    def test_code_sequence_reverses_counting_and_speed(self) -> None:
        node = booted(EncoderNode(32, turns(0.25, 0.1)))
        node.poll(0.0)
        speed = self.value(node, 0x6030, 1)
        node.receive(f("620 2B 00 60 00 05 00 00 00"), 0.0)
        assert self.value(node, 0x6004) == 65536 * 3 // 4
        assert self.value(node, 0x6030, 1) == -speed
        assert self.value(node, 0x6500) == 5

    def test_scaling_off_gives_the_physical_steps(self) -> None:
        node = booted(EncoderNode(32, turns(0.5), units_per_revolution=3600, total_units=3600))
        assert self.value(node, 0x6004) == 1800
        node.receive(f("620 2B 00 60 00 00 00 00 00"), 1.0)
        assert self.value(node, 0x6004) == 32768

    @pytest.mark.parametrize("request_", ["620 23 01 60 00 01 00 02 00", "620 23 02 60 00 01 00 02 00"])
    def test_units_beyond_the_physical_resolution_are_refused(self, request_: str) -> None:
        (answer,) = booted(EncoderNode()).receive(f(request_), 1.0)
        assert answer.data[4:] == bytes([0x30, 0x00, 0x09, 0x06])

    @pytest.mark.parametrize("request_", ["620 2F 01 30 00 08 00 00 00", "620 2F 00 30 00 7F 00 00 00"])
    def test_impossible_bit_rates_and_node_numbers_are_refused(self, request_: str) -> None:
        (answer,) = booted(EncoderNode()).receive(f(request_), 1.0)
        assert answer.data[0] == 0x80

    def test_an_encoder_reads_its_channels_value(self) -> None:
        channel = Cia406Encoder(device="cia406_encoder", name="theta", node=40, sign=-1, zero_counts=20000)
        node = booted(encoder_of(channel, lambda _: (30.0, 0.0), 7))
        counts = self.value(node, 0x6004)
        assert -(counts - 20000) * 360 / 65536 == pytest.approx(30.0, abs=360 / 65536)
        assert self.value(node, 0x1018, 4) == self.value(node, 0x650B) == 7

    def test_a_multi_turn_channel_makes_a_multi_turn_encoder(self) -> None:
        channel = Cia406Encoder(
            device="cia406_encoder", name="t", node=40, units_per_revolution=8192, total_units=8192 * 4096
        )
        node = booted(encoder_of(channel, lambda _: (725.0, 0.0), 7))
        assert self.value(node, 0x6004) == round(725 / 360 * 8192 - 0.5)
        assert self.value(node, 0x1000) == 0x00020196
        assert self.value(node, 0x6502) == 4096

    def test_a_linear_transducer_counts_steps_and_may_be_negative(self) -> None:
        channel = Cia406Linear(device="cia406_linear", name="L", node=48, zero_counts=-5000)
        node = booted(linear_of(channel, lambda _: (123.45, 8.0), 7))
        assert self.value(node, 0x6020, 1) == self.value(node, 0x6004) == 1234 - 5000
        assert self.value(node, 0x6501) == self.value(node, 0x6005, 1) == 100_000
        assert self.value(node, 0x6030, 1) == 800
        node.receive(f("630 23 03 60 00 F6 FF FF FF"), 1.0)
        assert self.value(node, 0x6020, 1) == -10

    @pytest.mark.parametrize(("mapped", "data"), [("7130", "34 07"), ("9130", "34 07 00 00"), ("6130", None)])
    def test_a_pressure_transmitter_sends_its_form_of_the_value(self, mapped: str, data: str | None) -> None:
        channel = Cia404Analogue(
            device="cia404", name="p", unit="bar", node=60, object=mapped, decimal_digits=1, scale=2.0, offset=1.0
        )
        node = booted(pressure_of(channel, lambda _: (369.8, 0.0), 7))  # (369.8 - 1) / 2 = 184.4 in its own unit
        node.receive(f("000 01 3C"), 1.0)
        (answer,) = node.receive(f("080"), 1.0)
        want = struct.pack("<f", 184.4) if data is None else bytes.fromhex(data.replace(" ", ""))
        assert answer == Frame(0x2BC, want)

    def test_values_that_do_not_fit_are_clipped(self) -> None:
        assert self.value(booted(PressureNode(60, lambda _: (1e6, 0.0))), 0x7130, 1) == 32767
        assert self.value(booted(LinearNode(48, lambda _: (0.0, -1e6))), 0x6030, 1) == -32768

    def test_a_commissioned_node_sends_on_sync_without_a_host(self) -> None:
        node = EncoderNode(32, turns(0.5))
        node.commission(sync=True, pdo=1, period_ms=20, heartbeat_ms=500)
        booted(node).receive(f("000 01 20"), 1.0)
        converse(node, [("080", "1A0 00 80 00 00")])
        assert node.next_deadline() == pytest.approx(0.782)


@pytest.fixture
def live_node() -> Iterator[tuple[EncoderNode, canopen.Network]]:
    """A node on a virtual bus, and python-canopen as its client."""
    channel = f"node-{uuid.uuid4()}"
    node = position_node(12345678)
    node.power_on(0.0)
    stop = threading.Event()
    with can.Bus(interface="virtual", channel=channel) as device:

        def serve() -> None:
            tick = 0
            while not stop.is_set():
                message = device.recv(0.01)
                tick += 1
                frames = node.poll(tick * 0.01)
                if message is not None:
                    frames += node.receive(Frame(message.arbitration_id, bytes(message.data)), tick * 0.01)
                for out in frames:
                    device.send(can.Message(arbitration_id=out.arbitration_id, data=out.data, is_extended_id=False))

        thread = threading.Thread(target=serve)
        thread.start()
        network = canopen.Network()
        network.connect(interface="virtual", channel=channel)
        try:
            yield node, network
        finally:
            network.disconnect()
            stop.set()
            thread.join()


def test_python_canopen_finds_a_faithful_device(live_node: tuple[EncoderNode, canopen.Network]) -> None:
    node, network = live_node
    remote = canopen.RemoteNode(32, canopen.ObjectDictionary())
    network.add_node(remote)
    remote.nmt.wait_for_bootup(5)
    sdo = remote.sdo
    assert sdo.upload(0x1008, 0) == b"SIM-CIA406"
    assert int.from_bytes(sdo.upload(0x6004, 0), "little") == 12345678
    sdo.download(0x6200, 0, (50).to_bytes(2, "little"))
    assert int.from_bytes(sdo.upload(0x1800, 5), "little") == 50
    with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
        sdo.upload(0x7654, 0)
    with pytest.raises(canopen.SdoAbortedError, match="0x06010002"):
        sdo.download(0x6004, 0, bytes(4))
    got = threading.Event()
    network.subscribe(0x1A0, lambda identifier, data, timestamp: got.set())
    network.nmt.send_command(0x01)
    assert got.wait(5)
    assert node.state is NmtState.OPERATIONAL
