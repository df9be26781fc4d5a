from __future__ import annotations

import configparser
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.eds import _first_bad_line
from drivers.canopen.pdo import PdoMapping, TransmitPdo
from drivers.errors import DescriptionError
from tests.drivers.can_support import EDS


def test_fields_follow_each_other_little_endian_at_any_bit_length() -> None:
    # MTS in-cylinder transducer: position, speed, work area state
    mapping = PdoMapping.from_words((0x60200120, 0x60300110, 0x64000108), "L2")
    bits = int.from_bytes(bytes.fromhex("FEFFFFFF0180AA"), "little")
    values = [field.extract_signed(bits) for field in mapping.fields]
    assert values == [-2, -32767, -86]
    assert [field.extract(bits) for field in mapping.fields] == [0xFFFFFFFE, 0x8001, 0xAA]
    assert mapping.words == (0x60200120, 0x60300110, 0x64000108)


def test_a_field_that_is_no_whole_byte_is_cut_out() -> None:
    mapping = PdoMapping.from_words((0x20000003, 0x20010005, 0x2002000C), "x")
    bits = 0b101 | 0b10011 << 3 | 0xABC << 8
    assert [field.extract(bits) for field in mapping.fields] == [0b101, 0b10011, 0xABC]


@given(
    st.lists(st.integers(min_value=1, max_value=32), min_size=1, max_size=8).filter(lambda b: sum(b) <= 64), st.data()
)
def test_what_is_packed_is_extracted(lengths: list[int], data: st.DataObject) -> None:
    mapping = PdoMapping.from_words([0x2000 << 16 | n for n in lengths], "x")
    values = [data.draw(st.integers(min_value=0, max_value=(1 << n) - 1)) for n in lengths]
    packed = sum(value << field.first_bit for value, field in zip(values, mapping.fields, strict=True))
    assert [field.extract(packed) for field in mapping.fields] == values


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ((), "no entries"),
        ((0x60040000,), "60040000h is not index"),
        ((1 << 33,), "is not index"),
        ((-1,), "is not index"),
        ((0x60040020, 0x60040020, 0x60300110), "80 bits; a frame has 64"),
    ],
)
def test_a_mapping_that_no_pdo_can_have_is_refused(words: tuple[int, ...], reason: str) -> None:
    with pytest.raises(DescriptionError, match=rf"node 32, TPDO1: .*{reason}"):
        TransmitPdo.usual(32, 1, words)


def test_objects_are_found_by_index_and_sub_index() -> None:
    mapping = PdoMapping.from_words((0x60200120, 0x60200220), "x")
    assert mapping.find(0x6020) is mapping.fields[0]
    assert mapping.find(0x6004) is None


def test_the_shipped_eds_describes_both_pdos_by_number_from_one() -> None:
    first, second = TransmitPdo.from_eds(EDS, 32, 1), TransmitPdo.from_eds(EDS, 32, 2)
    assert (first.arbitration_id, second.arbitration_id) == (0x1A0, 0x2A0)
    assert first.mapping.words == second.mapping.words == (0x60040020,)
    assert first == TransmitPdo.usual(32, 1, (0x60040020,))


def test_a_pdo_with_an_extended_identifier_is_read(tmp_path: Path) -> None:
    text = EDS.read_text(encoding="latin-1").replace("$NODEID+0x180", "0x2CFE3021")
    path = tmp_path / "extended.eds"
    path.write_text(text, encoding="latin-1")
    pdo = TransmitPdo.from_eds(path, 32, 1)
    assert (pdo.arbitration_id, pdo.is_extended) == (0x0CFE3021, True)


def changed(tmp_path: Path, old: str, new: str) -> Path:
    text = EDS.read_text(encoding="latin-1")
    assert old in text
    path = tmp_path / "device.eds"
    path.write_text(text.replace(old, new), encoding="latin-1")
    return path


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("[FileInfo]", "FileInfo", "not a valid EDS: File contains no section headers"),
        ("ObjectType=0x7", "ObjectType=seven", "not a valid EDS: invalid literal"),
        ("[1800sub1]", "[1800sub9]", r"object 1800h\.1 is not described"),
        ("DefaultValue=0x60040020", "DefaultValue=many", r"object 1A00h\.1 has no DefaultValue"),
        ("DefaultValue=0x60040020", "DefaultValue=0", r"TPDO1: PDO mapping entry 00000000h"),
        ("[1A00sub0]\nParameterName=Number", "[1A00sub0]\nParameterNam=Number", "not a valid EDS: No option"),
    ],
)
def test_a_malformed_eds_is_refused_with_file_and_reason(tmp_path: Path, old: str, new: str, reason: str) -> None:
    path = changed(tmp_path, old, new)
    with pytest.raises(DescriptionError, match=reason) as caught:
        TransmitPdo.from_eds(path, 32, 1)
    assert str(caught.value).startswith(str(path))


def test_an_absurd_number_of_mapping_entries_is_refused(tmp_path: Path) -> None:
    path = changed(tmp_path, "[1A00sub0]\nParameterName=Number of mapped objects", "[1A00sub0]\nParameterName=Number")
    text = path.read_text(encoding="latin-1")
    start = text.index("[1A00sub0]")
    path.write_text(text[:start] + text[start:].replace("DefaultValue=1", "DefaultValue=200", 1), encoding="latin-1")
    with pytest.raises(DescriptionError, match=r"object 1A00h\.0: 200 mapping entries"):
        TransmitPdo.from_eds(path, 32, 1)


def test_a_pdo_that_the_eds_lacks_is_named() -> None:
    with pytest.raises(DescriptionError, match=r"object 1802h\.1 is not described"):
        TransmitPdo.from_eds(EDS, 32, 3)


def test_a_missing_eds_is_named(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"none\.eds: cannot be read: No such file"):
        TransmitPdo.from_eds(tmp_path / "none.eds", 32, 1)


@given(
    st.lists(
        st.sampled_from(
            ["[a]", "[a", "a=1", " a=1", "  b", "b", "", ";c", "#c", " ;c", "=1", "a ;c", "a: 1", "a=1 ;c=2"]
        )
    )
)
def test_a_bad_line_of_an_eds_file_is_one_that_its_parser_refuses(lines: list[str]) -> None:
    text = "\n".join(["[s]", *lines])
    refused = None
    try:
        configparser.RawConfigParser(inline_comment_prefixes=(";",), strict=False).read_string(text)
    except configparser.ParsingError as error:
        refused = error.errors[0][0]
    assert _first_bad_line(text) == refused
