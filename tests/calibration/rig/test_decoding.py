"""The decoding that DBC and EDS files give a rig's channels, in the text that is stored with sessions and models."""

from __future__ import annotations

import pytest

from calibration.errors import RigError
from calibration.rig.decoding import without_decoding
from calibration.rig.description import Rig, parse_rig, shipped_rig
from tests.calibration.conftest import rig_text

PLAIN = shipped_rig("swdt82")
BEFORE = {"pump": "frame 201h, 0.1 * integer", "temp": 'frame 201h, "degC" \\'}
AFTER = BEFORE | {"pump": "frame 201h, 0.01 * integer"}


def test_the_text_of_a_rig_with_a_decoding_is_read_back_and_gives_the_file_again() -> None:
    rig = PLAIN.with_decoding(BEFORE)
    assert parse_rig(rig.text, "stored").decoding == BEFORE
    assert without_decoding(rig.text) == PLAIN.text == without_decoding(PLAIN.text)
    assert rig.with_decoding(BEFORE) is rig
    assert rig.with_decoding(AFTER).text == PLAIN.with_decoding(AFTER).text
    assert rig.with_decoding({}).text == PLAIN.text


def test_signals_may_be_added_behind_a_decoding_and_the_decoding_changed_before_them() -> None:
    rig = PLAIN.with_decoding(BEFORE).with_signals("tilt_x_deg").with_decoding(AFTER)
    assert (rig.decoding, [signal.name for signal in rig.signals]) == (AFTER, ["tilt_x"])
    assert without_decoding(rig.text) == PLAIN.with_signals("tilt_x_deg").text


@pytest.mark.parametrize(
    ("here", "there", "differs"),
    [
        (PLAIN.with_decoding(AFTER), PLAIN.with_decoding(BEFORE), True),
        (PLAIN.with_decoding(AFTER), PLAIN.with_decoding({"temp": BEFORE["temp"]}), False),
        (PLAIN.with_decoding(AFTER), PLAIN, False),
        (PLAIN, PLAIN.with_decoding(BEFORE), False),
    ],
    ids=["both", "not of this channel", "older recording", "rig file alone"],
)
def test_a_decoding_is_another_one_only_where_both_rigs_tell_it(here: Rig, there: Rig, *, differs: bool) -> None:
    assert here.misreading(there) == (
        "its channel pump is decoded as frame 201h, 0.1 * integer, this one as frame 201h, 0.01 * integer"
        if differs
        else ""
    )
    assert here.differences(there) == (("decoding",) if differs else ())


def test_nobody_is_told_to_write_a_decoding() -> None:
    with pytest.raises(
        RigError, match=r"decodings: unknown key; allowed here: name, convention, .*, station \(line 1\)$"
    ):
        parse_rig(f"decodings = 1\n{rig_text('swdt82')}", "mine.toml")
