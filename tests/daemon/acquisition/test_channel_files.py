"""What DBC and EDS files say of a rig's channels is part of the rig that the daemon runs and records."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibration.rig.description import parse_rig
from daemon.acquisition.channel_files import with_files
from daemon.composition import live
from daemon.config.config import parse_config
from daemon.rig_files import load_rig, misreading
from drivers.can.dbc import DbcFile
from drivers.canopen.pdo import PdoField, PdoMapping, TransmitPdo
from drivers.errors import DescriptionError
from tests.bench.store_growth import CONFIG
from tests.daemon.support.rig_files import ANOTHER_FACTOR, ANOTHER_LENGTH, Change, decoded_rig, own_rig

PUMP = "frame 201h, 16 unsigned bits from intel bit 0, 0.1 * integer + 0.0 bar"
THETA1 = "frame 1A0h, 32 bits from bit 0, object 6004h.0"


def test_each_channel_that_names_a_file_has_its_decoding_and_no_other_has_one(tmp_path: Path) -> None:
    source = decoded_rig(tmp_path)
    named = [channel.name for channel in source.rig.channels if channel.device == "dbc"]
    assert sorted(source.rig.decoding) == sorted([*named, "theta1"])
    assert (source.rig.decoding["pump"], source.rig.decoding["theta1"]) == (PUMP, THETA1)
    assert parse_rig(source.text, "stored") == source.rig


def test_the_daemon_runs_and_records_a_rig_with_the_decoding_and_its_file_stays_as_it_is(tmp_path: Path) -> None:
    source = own_rig(tmp_path)
    parts = live(parse_config(CONFIG, tmp_path), source)
    assert parts.rig.decoding["pump"] == PUMP
    assert (
        parts.rig_text == parts.rig.text == f"{source.text}\n[decoding]\n" + parts.rig_text.partition("[decoding]\n")[2]
    )
    assert load_rig(str(tmp_path / "swdt82.toml")).rig.decoding == {}


def test_a_rig_without_files_keeps_its_text(tmp_path: Path) -> None:
    source = load_rig("ur10")
    assert with_files(source)[0] is source


def test_a_file_that_was_taken_from_a_recording_is_decoded_by_the_files_that_are_there_now(tmp_path: Path) -> None:
    """The rig file in a model, or in an export, has the decoding of its time."""
    recorded = decoded_rig(tmp_path)
    now = decoded_rig(tmp_path, ANOTHER_FACTOR)
    (tmp_path / "swdt82.toml").write_text(recorded.text)
    assert with_files(load_rig(str(tmp_path / "swdt82.toml")))[0].text == now.text


@pytest.mark.parametrize(
    ("dbc", "eds", "why"),
    [
        (
            ANOTHER_FACTOR,
            ("", ""),
            f"its channel pump is decoded as {PUMP}, this one as {PUMP.replace('0.1', '0.01')}",
        ),
        (
            ("", ""),
            ANOTHER_LENGTH,
            f"its channel theta1 is decoded as {THETA1}, this one as {THETA1.replace('32', '16')}",
        ),
        (("SG_ ErrFlags : 60|4@1+ (1,0)", "SG_ Flags : 61|3@1+ (2,0)"), ("", ""), ""),
        (("BO_ 2365468705 AuxValve0Cmd", "BO_ 7 New: 8 DAQ\n\nBO_ 2365468705 AuxValve0Cmd"), ("", ""), ""),
        (("", ""), ("ProductName=CiA406 sim", "ProductName=another"), ""),
        (("", ""), ("[1A01sub1]\nParameterName=Map 1", "[1A01sub1]\nParameterName=Map one"), ""),
    ],
    ids=["factor", "EDS mapping", "another signal", "a message more", "EDS name", "another PDO of the EDS"],
)
def test_only_the_own_signal_of_a_channel_makes_its_readings_others(
    tmp_path: Path, dbc: Change, eds: Change, why: str
) -> None:
    before = decoded_rig(tmp_path / "before")
    after = decoded_rig(tmp_path / "after", dbc, eds)
    assert misreading(after.rig, before.text, "r") == why
    assert after.rig.differences(before.rig) == (("decoding",) if why else ())


def test_an_older_recording_has_no_decoding_and_is_read_as_before(tmp_path: Path) -> None:
    older = own_rig(tmp_path / "before")
    after = decoded_rig(tmp_path / "after", ANOTHER_FACTOR, ANOTHER_LENGTH)
    assert misreading(after.rig, older.text, "r") == ""
    assert misreading(older.rig, after.text, "r") == ""
    assert older.rig.differences(after.rig) == ()


def test_a_dbc_file_is_read_once_for_all_of_its_channels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []
    init = DbcFile.__init__

    def counted(file: DbcFile, path: Path) -> None:
        read.append(path)
        init(file, path)

    monkeypatch.setattr(DbcFile, "__init__", counted)
    live(parse_config(CONFIG, tmp_path), own_rig(tmp_path))
    assert read == [tmp_path / "machine.dbc"]


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    source = own_rig(tmp_path)
    (tmp_path / "machine.dbc").unlink()
    with pytest.raises(DescriptionError, match=r"machine\.dbc: cannot be read"):
        with_files(source)


def test_the_place_of_a_value_in_a_pdo_changes_with_what_lies_before_it_alone() -> None:
    position, speed = PdoField(0x6004, 0, 0, 32), PdoField(0x6030, 1, 32, 16)
    alone, before = PdoMapping((position,)), PdoMapping((position, speed))
    behind = PdoMapping.from_words([speed.word, position.word], "PDO")
    told = [TransmitPdo(0x1A0, False, mapping).decoding(0x6004) for mapping in (alone, before, behind)]
    assert told == [THETA1, THETA1, THETA1.replace("bit 0", "bit 16")]
    assert TransmitPdo(0x1A0, True, alone).decoding(0x6020) == "frame 000001A0h, without object 6020h"
