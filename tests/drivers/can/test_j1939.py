from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.dbc import DbcFile
from drivers.can.frame import EXTENDED_ID_MAX
from drivers.can.j1939 import GLOBAL_ADDRESS, J1939Id
from tests.drivers.can_support import DBC


@pytest.mark.parametrize(
    ("arbitration_id", "parsed", "text"),
    [
        (0x0CFE3021, J1939Id(3, 0xFE30, 0x21, None), "PGN FE30h from 21h, priority 3"),
        (0x18EAFF21, J1939Id(6, 0xEA00, 0x21, 255), "PGN EA00h (request) from 21h to all, priority 6"),
        (0x18FECA00, J1939Id(6, 0xFECA, 0x00, None), "PGN FECAh (DM1, active faults) from 00h, priority 6"),
        (0x18EF0B21, J1939Id(6, 0xEF00, 0x21, 0x0B), "PGN EF00h from 21h to 0Bh, priority 6"),
        (0x1DF01021, J1939Id(7, 0x1F010, 0x21, None), "PGN 1F010h from 21h, priority 7"),
    ],
)
def test_identifiers_of_the_protocol_facts(arbitration_id: int, parsed: J1939Id, text: str) -> None:
    assert J1939Id.parse(arbitration_id) == parsed
    assert str(parsed) == text


def test_an_extended_identifier_is_stored_in_a_dbc_with_bit_31_set() -> None:
    assert "BO_ 2365468705 AuxValve0Cmd" in DBC.read_text(encoding="cp1252")
    channel = DbcFile(DBC).channel("flow", "%", "AuxValve0Cmd", "PortFlowCmd_pct")
    assert channel.is_extended
    assert J1939Id.parse(channel.arbitration_id) == J1939Id(3, 0xFE30, 0x21, None)


@given(st.integers(0, EXTENDED_ID_MAX))
def test_no_bit_of_an_identifier_is_lost(arbitration_id: int) -> None:
    parsed = J1939Id.parse(arbitration_id)
    destination = 0 if parsed.destination is None else parsed.destination
    assert parsed.priority << 26 | parsed.pgn << 8 | destination << 8 | parsed.source == arbitration_id
    assert (parsed.destination is None) == (parsed.pgn >> 8 & 0xFF >= 0xF0)
    assert 0 <= destination <= GLOBAL_ADDRESS


@pytest.mark.parametrize("arbitration_id", [-1, EXTENDED_ID_MAX + 1, 2365468705])
def test_what_has_more_than_29_bits_is_refused(arbitration_id: int) -> None:
    with pytest.raises(ValueError, match="not a 29-bit identifier"):
        J1939Id.parse(arbitration_id)
