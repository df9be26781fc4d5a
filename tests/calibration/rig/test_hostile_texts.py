"""Texts and archives that would take more memory or time than they may: each is one sentence."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np
import pytest

from calibration.errors import DataError, RigError
from calibration.numerics.stored_arrays import read_npz
from calibration.observations import parse_observations
from calibration.rig.description import parse_rig, shipped_rig
from tests.calibration.conftest import rig_text

RIG = shipped_rig("ur10")
HEADER = b"prism,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm"
ROW = b"tmac,1,2,3,4,5,6,1000,2000,3000"


# ---- TOML ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("name = " + "9" * 5000, "not valid TOML: Exceeds the limit"),
        ("name = 9223372036854775808", "name: the whole number does not fit into 64 bits"),
        ("station = { a = [[9223372036854775808]] }", "a: the whole number does not fit into 64 bits"),
        ("a." * 100_000 + "b = 1", "line 1: more than 100 dots in its keys"),
        ("[" + "a . " * 200 + "b]", "line 1: more than 100 dots in its keys"),
        ("a = " + "[" * 100_000, "nested too deeply"),
        ("a = " + "{b=" * 10_000, "nested too deeply"),
        ("#" * (1 << 20), "the text has 1,048,576 characters; the maximum is 524,288"),
        (rig_text("ur10") + '[[prism]]\nname = "a"\nframe = 1\noffset_mm = [0, 0, 0]\n' * 300, "prism: .* at most 300"),
    ],
)
def test_a_rig_file_that_no_parser_ends_with_is_refused(text: str, reason: str) -> None:
    with pytest.raises(RigError, match=reason) as caught:
        parse_rig(text, "rig.toml")
    assert str(caught.value).startswith("rig.toml: ")
    assert len(str(caught.value)) < 1100


def test_the_byte_order_mark_of_an_editor_is_no_part_of_a_rig_file() -> None:
    text = shipped_rig("ur10").text
    assert parse_rig("\ufeff" + text.replace("\n", "\r\n"), "mine.toml").rows == parse_rig(text, "ur10").rows


def test_points_in_comments_and_numbers_are_no_parts_of_keys() -> None:
    text = rig_text("ur10")
    parse_rig(f"# {'.' * 300}\n# {'. ' * 300}\n{text}", "rig.toml")


# ---- observations ----------------------------------------------------------------------------------------------------


def refused(data: bytes, reason: str) -> None:
    with pytest.raises(DataError, match=reason) as caught:
        parse_observations(data, RIG, "data.csv")
    assert len(str(caught.value)) < 1100


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (
            b"\n".join((HEADER, ROW + b"," * (2 << 20))),
            "line 2: not a CSV file: a row has more than 1,048,576 characters",
        ),
        (b"\n".join((HEADER, b'"' + b"a\n" * (1 << 20))), "not a CSV file: field larger than field limit"),
        (b"\n".join((HEADER, b'"a\nb",' * 300_000)), "not a CSV file: a row has more than 1,048,576 characters"),
        (HEADER + b",c" * 1000 + b"\n", "line 1: 1010 columns; the maximum is 1000"),
        (
            b"\n".join((HEADER, ROW.replace(b"1000", b"1" * 10_000))),
            r"line 2, column x_mm: '1{20}'\.\.\. of 10000 char",
        ),
        (b"\n".join((HEADER, ROW + b"\0")), "line 2: contains a zero byte"),
        (b"\n".join((HEADER, ROW, ROW + b"\xff")), "line 3: byte .* is not UTF-8"),
        (b"\n".join((HEADER, ROW, ROW + b"\xff" * 100_000, ROW)), "line 3: byte .* is not UTF-8"),
        (
            b"\n".join((HEADER + b",setup", ROW + b"," + b"a" * 200, *[ROW + b",b"] * 100_000)),
            "line 2, column setup: the label has 200 characters, too many in a table of 100001 rows; shorten it",
        ),
    ],
)
def test_observations_that_would_fill_the_memory_are_refused_with_their_line(data: bytes, reason: str) -> None:
    refused(data, reason)


def test_a_row_of_many_lines_is_counted_from_its_own_beginning() -> None:
    note = b'"' + b"a\n" * 300_000 + b'"'
    rows = [ROW + b',"' + b"a\n" * 50_000 + b'"'] * 30
    assert len(note) < 1 << 20
    found = parse_observations(b"\n".join((HEADER + b",note", *rows)), RIG, "data.csv")
    assert (len(found), found.ignored_columns) == (30, ("note",))


# ---- arrays ----------------------------------------------------------------------------------------------------------


def saved(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **arrays)
    return out.getvalue()


def test_arrays_come_back_as_they_were_written() -> None:
    arrays = {
        "rows": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "names": np.array(["a", "bc"]),
        "number": np.array(7),
        "empty": np.empty((0, 3)),
        "none": np.array([], dtype=np.str_),
    }
    found = read_npz(saved(**arrays))
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
        assert found[name].flags.f_contiguous == array.flags.f_contiguous
        assert found[name].flags.writeable


def member(shape: str, descr: str = "'<f8'", body: bytes = b"") -> bytes:
    """An archive with one array whose header says what it likes."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body)
    return out.getvalue()


def overlapping() -> bytes:
    """An archive whose index names one array a hundred times."""
    data = bytearray(saved(a=np.zeros(1000)))
    start = data.rindex(b"PK\x01\x02")
    end = data.rindex(b"PK\x05\x06")
    entry = bytes(data[start:end])
    return (
        bytes(data[:start])
        + entry * 100
        + b"PK\x05\x06"
        + struct.pack("<HHHHIIH", 0, 0, 100, 100, len(entry) * 100, start, 0)
    )


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (member("(999999999999,)"), "does not hold an array of float64"),
        (member("(-1,)"), "does not hold an array"),
        (member("(1,)", "'|O'", bytes(8)), "does not hold an array of object"),
        (member("(1,)", "'<U0'"), "does not hold an array"),
        (member("(" * 5000), "damaged"),
        (overlapping(), "an archive declares more data than its own size"),
        (b"", "damaged"),
        (b"PK\x03\x04", "damaged"),
    ],
)
def test_an_archive_that_promises_more_than_it_has_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        read_npz(data)


def test_two_megabytes_of_compressed_zeros_are_no_arrays_of_a_model() -> None:
    out = io.BytesIO()
    np.savez_compressed(out, covariance=np.zeros((2000, 2000)))
    assert len(out.getvalue()) < 100_000
    with pytest.raises(ValueError, match="compressed"):
        read_npz(out.getvalue())
