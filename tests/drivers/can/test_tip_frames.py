"""The live tip as CAN frames: what is sent, what a receiver makes of it, and what may not be sent."""

import math
import threading
from pathlib import Path

import can
import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

import drivers.can
from drivers.can.frame import Frame
from drivers.can.tip_frames import TipMessage, TipStatus, encode_tip
from drivers.canopen.transmit import FREE_IDENTIFIERS, TransmitPermission
from drivers.errors import TransmitForbiddenError
from drivers.readings import CanCapture, DeviceEvent, EventKind, Gap
from tests.drivers.can_support import DEADLINE_S, Heard, unused_channel, virtual_bus, virtual_link

DBC = cantools.database.load_file(Path(drivers.can.__file__).with_name("tip.dbc"), database_format="dbc")
IDENTIFIER = 0x680


def decoded(frames: list[Frame]) -> dict[str, float | int]:
    """Return the values that a receiver with the shipped DBC reads."""
    found: dict[str, float | int] = {}
    for frame in frames:
        found |= DBC.decode_message(frame.arbitration_id, frame.data, decode_choices=False)
    return found


def test_the_bytes_are_those_of_the_document() -> None:
    tip = TipMessage(TipStatus.OK, (10_000.0, -2_000.5, 0.1), sigma_mm=3.4, age_s=0.05)
    assert [str(frame) for frame in encode_tip(tip, IDENTIFIER, 258)] == [
        "680 [8] A0 86 01 DB B1 FF 02 00",
        "681 [8] 01 00 00 22 00 05 02 00",
    ]


@given(
    st.tuples(*[st.floats(-838_860.0, 838_860.0)] * 3),
    st.floats(0.0, 6553.0),
    st.floats(0.0, 2.5),
    st.integers(0, 10**6),
)
def test_the_shipped_dbc_reads_what_was_sent(
    position: tuple[float, float, float], sigma: float, age: float, counter: int
) -> None:
    got = decoded(encode_tip(TipMessage(TipStatus.DOUBTFUL, position, sigma, age), IDENTIFIER, counter))
    assert [got["tip_x"], got["tip_y"], got["tip_z"]] == pytest.approx(position, abs=0.0501)
    assert got["tip_sigma"] == pytest.approx(sigma, abs=0.0501)
    assert got["tip_age"] == pytest.approx(age, abs=0.00501)
    assert got["tip_xy_counter"] == got["tip_z_counter"] == counter % 256
    assert got["tip_xy_status"] == got["tip_z_status"] == TipStatus.DOUBTFUL


@pytest.mark.parametrize("status", [s for s in TipStatus if not s.has_position])
def test_a_status_without_a_position_carries_no_number_that_looks_like_one(status: TipStatus) -> None:
    got = decoded(encode_tip(TipMessage(status, (1.0, 2.0, 3.0), 1.0, 0.1), IDENTIFIER, 0))
    assert [got["tip_x"], got["tip_y"], got["tip_z"]] == pytest.approx([-838_860.8] * 3)
    assert (got["tip_sigma"], got["tip_age"]) == pytest.approx((6553.5, 2.55))
    assert got["tip_xy_status"] == got["tip_z_status"] == status


def test_what_the_frames_cannot_hold_is_a_failure_and_no_wrong_number() -> None:
    far = decoded(encode_tip(TipMessage(TipStatus.OK, (0.0, 0.0, 838_861.0), 1.0, 0.1), IDENTIFIER, 0))
    assert far["tip_z_status"] == TipStatus.FAILED
    assert far["tip_x"] == pytest.approx(-838_860.8)
    vague = decoded(encode_tip(TipMessage(TipStatus.OK, (0.0, 0.0, 0.0), 1e9, 1e9), IDENTIFIER, 0))
    assert (vague["tip_sigma"], vague["tip_age"]) == pytest.approx((6553.4, 2.54))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_sent_as_not_known(value: float) -> None:
    lost = decoded(encode_tip(TipMessage(TipStatus.OK, (0.0, value, 0.0), 1.0, 0.1), IDENTIFIER, 0))
    assert lost["tip_xy_status"] == TipStatus.FAILED
    if value != -math.inf:
        vague = decoded(encode_tip(TipMessage(TipStatus.OK, (0.0, 0.0, 0.0), value, value), IDENTIFIER, 0))
        assert (vague["tip_sigma"], vague["tip_age"]) == pytest.approx((6553.4, 2.54))


def test_every_status_has_a_name_in_the_dbc() -> None:
    for message, signal in (("RIGCAL_TIP_XY", "tip_xy_status"), ("RIGCAL_TIP_Z", "tip_z_status")):
        choices = DBC.get_message_by_name(message).get_signal_by_name(signal).choices
        assert {value: str(name) for value, name in choices.items()} == {s.value: s.name.lower() for s in TipStatus}


# ---- what may be sent ------------------------------------------------------------------------------------------------


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans())
def test_without_configured_identifiers_no_message_of_rigcal_passes(identifier: int, data: bytes, allow: bool) -> None:
    if identifier in FREE_IDENTIFIERS:
        with pytest.raises(TransmitForbiddenError):
            TransmitPermission("boom", allow, ()).check(Frame(identifier, data))


def test_a_configured_identifier_opens_itself_and_nothing_else() -> None:
    gate = TransmitPermission("boom", True, (), (0x680, 0x681))
    gate.check(Frame(0x680, bytes(8)))
    for other in (Frame(0x682, bytes(8)), Frame(0x680, b"", is_remote=True), Frame(0x680, bytes(8), is_extended=True)):
        with pytest.raises(TransmitForbiddenError, match="of a kind that rigcal never sends"):
            gate.check(other)


def test_a_listen_only_link_takes_no_identifiers() -> None:
    with pytest.raises(TransmitForbiddenError, match="listen-only"):
        TransmitPermission("boom", False, (), (0x680,))


@pytest.mark.parametrize("identifier", [0x000, 0x080, 0x181, 0x201, 0x601, 0x67F, 0x6E0, 0x701, 0x7E5, 0x800, -1])
def test_identifiers_that_canopen_needs_are_none_of_its_own(identifier: int) -> None:
    with pytest.raises(TransmitForbiddenError, match="680h to 6DFh"):
        TransmitPermission("boom", True, range(128), (identifier,))


def test_a_link_publishes_the_newest_frames_on_the_bus_and_captures_them_as_sent() -> None:
    channel = unused_channel()
    link = virtual_link(channel, allow_transmit=True, own_identifiers=(0x680, 0x681))
    heard, stop = Heard(), threading.Event()

    def emit(item: CanCapture | DeviceEvent | Gap) -> None:
        heard(item)
        if isinstance(item, DeviceEvent) and item.kind is EventKind.LINK_UP:
            for number in range(3):  # before the link sends any of them: only the newest is left
                link.publish(encode_tip(TipMessage(TipStatus.NO_MODEL), 0x680, number))

    thread = threading.Thread(target=link.run, args=(emit, stop))
    with virtual_bus(channel) as bus:
        thread.start()
        heard.wait(lambda: len(heard.sent) == 2, "two frames")
        received: list[can.Message] = [m for m in (bus.recv(1.0), bus.recv(1.0)) if m is not None]
        assert [(m.arbitration_id, m.data[6]) for m in received] == [(0x680, 2), (0x681, 2)]
        assert bus.recv(0.0) is None
        stop.set()
        thread.join(DEADLINE_S)


def test_a_link_publishes_nothing_that_it_was_not_configured_for() -> None:
    for settings in ({}, {"allow_transmit": True}, {"allow_transmit": True, "own_identifiers": (0x690, 0x691)}):
        link = virtual_link(unused_channel(), **settings)
        with pytest.raises(TransmitForbiddenError):
            link.publish(encode_tip(TipMessage(TipStatus.OK, (1.0, 2.0, 3.0), 1.0, 0.1), 0x680, 0))
