from __future__ import annotations

import pytest

from drivers.canopen.cia301 import CobId, NmtCommand, NmtState, Service, classify, decode_heartbeat, encode_nmt
from drivers.canopen.emcy import decode_emergency, error_register_words


def test_emergency_of_the_protocol_facts() -> None:
    emergency = decode_emergency(bytes.fromhex("0050810102030405"))
    assert (emergency.code, emergency.register, emergency.manufacturer) == (0x5000, 0x81, bytes((1, 2, 3, 4, 5)))
    assert emergency.words == "emergency 5000h (device hardware), error register 81h (generic, manufacturer)"
    assert not emergency.is_reset


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("0000000000000000", "0000h (error reset), error register 00h (none)"),
        ("2081110000000000", "8120h (CAN in error passive mode), error register 11h (generic, communication)"),
        ("4081110000000000", "8140h (recovered from bus-off), error register 11h (generic, communication)"),
        ("00A0000000000000", "A000h (unknown code), error register 00h (none)"),
    ],
)
def test_emergency_codes_are_put_into_words(data: str, words: str) -> None:
    assert decode_emergency(bytes.fromhex(data)).words == f"emergency {words}"


def test_every_bit_of_the_error_register_has_a_name() -> None:
    assert error_register_words(0xFF).count(",") == 7


def test_an_emergency_of_other_length_is_refused() -> None:
    with pytest.raises(ValueError, match="8 bytes, this one has 3"):
        decode_emergency(bytes(3))


@pytest.mark.parametrize(
    ("data", "state"),
    [
        (b"\x00", NmtState.BOOT_UP),
        (b"\x04", NmtState.STOPPED),
        (b"\x05", NmtState.OPERATIONAL),
        (b"\x7f", NmtState.PRE_OPERATIONAL),
        (b"\x85", NmtState.OPERATIONAL),
    ],
)
def test_heartbeat_states(data: bytes, state: NmtState) -> None:
    assert decode_heartbeat(data) is state


@pytest.mark.parametrize("data", [b"", b"\x05\x00", b"\x50", b"\x60"])
def test_a_heartbeat_that_is_none_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"1 byte|not an NMT state"):
        decode_heartbeat(data)


def test_nmt_start_of_the_protocol_facts() -> None:
    assert str(encode_nmt(NmtCommand.START, 0x20)) == "000 [2] 01 20"


@pytest.mark.parametrize(
    ("arbitration_id", "meaning"),
    [
        (0x000, CobId(Service.NMT)),
        (0x080, CobId(Service.SYNC)),
        (0x0A0, CobId(Service.EMCY, 32)),
        (0x100, CobId(Service.TIME)),
        (0x1A0, CobId(Service.TPDO, 32)),
        (0x220, CobId(Service.RPDO, 32)),
        (0x2A0, CobId(Service.TPDO, 32)),
        (0x320, CobId(Service.RPDO, 32)),
        (0x3A0, CobId(Service.TPDO, 32)),
        (0x420, CobId(Service.RPDO, 32)),
        (0x4A0, CobId(Service.TPDO, 32)),
        (0x520, CobId(Service.RPDO, 32)),
        (0x5A0, CobId(Service.SDO_RESPONSE, 32)),
        (0x620, CobId(Service.SDO_REQUEST, 32)),
        (0x720, CobId(Service.HEARTBEAT, 32)),
        (0x7E4, CobId(Service.LSS)),
        (0x7E5, CobId(Service.LSS)),
        (0x680, None),
        (0x001, None),
        (0x180, None),
    ],
)
def test_identifiers_are_told_apart(arbitration_id: int, meaning: CobId | None) -> None:
    assert classify(arbitration_id) == meaning
