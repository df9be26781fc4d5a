from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.frame import Frame
from drivers.canopen.transmit import TransmitPermission
from drivers.errors import TransmitForbiddenError


def test_a_link_that_may_not_transmit_refuses_every_frame() -> None:
    gate = TransmitPermission("boom", False, (32,))
    for arbitration_id in range(0x800):
        with pytest.raises(TransmitForbiddenError, match="boom: the link is listen-only; set allow_transmit = true"):
            gate.check(Frame(arbitration_id, b"\x01\x20"))


@pytest.mark.parametrize("frame", ["080", "080#01", "100#00B4C404E238", "000#0120", "620#40", "220#00", "520#"])
def test_what_a_listed_node_and_the_bus_may_get(frame: str) -> None:
    identifier, _, data = frame.partition("#")
    TransmitPermission("boom", True, (32,)).check(Frame(int(identifier, 16), bytes.fromhex(data)))


@pytest.mark.parametrize("frame", ["000#0121", "621#40", "221#00"])
def test_a_node_that_is_not_listed_gets_nothing(frame: str) -> None:
    identifier, _, data = frame.partition("#")
    with pytest.raises(TransmitForbiddenError, match=r"node 33 is not listed in transmit_nodes \(listed: 32\)"):
        TransmitPermission("boom", True, (32,)).check(Frame(int(identifier, 16), bytes.fromhex(data)))


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x000, b"\x01\x00"),
        Frame(0x000, b"\x01"),
        Frame(0x7E5, bytes(8)),
        Frame(0x1A0, bytes(4)),
        Frame(0x5A0, bytes(8)),
        Frame(0x720, b"\x05"),
        Frame(0x620, bytes(8), is_extended=True),
        Frame(0x620, b"", is_remote=True),
        Frame(0x6A0, b""),
    ],
)
def test_some_frames_are_never_sent(frame: Frame) -> None:
    with pytest.raises(TransmitForbiddenError, match="of a kind that rigcal never sends"):
        TransmitPermission("boom", True, range(128)).check(frame)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_nothing_passes_to_a_node_that_is_not_listed(arbitration_id: int, data: bytes) -> None:
    gate = TransmitPermission("boom", True, (32,))
    try:
        gate.check(Frame(arbitration_id, data))
    except TransmitForbiddenError:
        return
    assert arbitration_id in (0x080, 0x100) or arbitration_id & 0x7F == 32 or (arbitration_id == 0 and data[1] == 32)
