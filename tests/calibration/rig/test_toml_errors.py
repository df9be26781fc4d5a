"""What is wrong with a key of a rig file is said in words of TOML: texts in quotes, lists, tables."""

from __future__ import annotations

import re

import pytest

from calibration.errors import RigError
from calibration.rig.description import parse_rig
from tests.calibration.conftest import rig_text

TEXT = rig_text("ur10")
PRISM = '[[prism]]\nname = "further"\nframe = 1\n'


def told(text: str) -> str:
    with pytest.raises(RigError) as refused:
        parse_rig(text, "rig.toml")
    return str(refused.value)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("[[row]]\ndrive = { fo = { q1 = 1 } }", "row.7.drive.fo: is not a valid key: it must be 'theta', 'd' or 'a'"),
        ('[[row]]\na_mm = "x"', "row.7.a_mm: must be a number"),
        ("[[row]]\na_mm = inf", "row.7.a_mm: must be a finite number"),
        ("[[row]]\nafter = -1", "row.7.after: must be 0 or more"),
        ("[[row]]\nbefore = 3", "row.7.before: must be a table, with its keys below a header in square brackets"),
        ("[[row]]\nidentify = 3", "row.7.identify: must be a list, in square brackets"),
        (f"{PRISM}offset_mm = [1, 2, 3, 4]", "offset_mm: must have at most 3"),
        (f"{PRISM}offset_mm = [1, 2, 3]\noffset_known = 3", "offset_known: must be true or false"),
        ('[[channel]]\nname = "x"', "lacks the key 'device', which selects its kind"),
        (
            '[[channel]]\nname = "t"\ndevice = "cia406_linear"\nnode = 9\nunit = "bar"',
            "channel.1.cia406_linear.unit: must be 'mm'",
        ),
        (
            '[[channel]]\nname = "t"\ndevice = "cia406_encoder"\nnode = 9\nunit = "mm"',
            "channel.1.cia406_encoder.unit: must be 'deg'",
        ),
        ('[[channel]]\ndevice = "x"', "'device' must be one of 'cia406_encoder', 'cia406_linear', "),
    ],
)
def test_what_a_value_must_be_is_said(line: str, reason: str) -> None:
    assert reason in told(f"{TEXT}\n{line}\n")


@pytest.mark.parametrize("section", ["joint", "row", "prism"])
def test_a_list_of_tables_is_asked_for_by_its_header(section: str) -> None:
    others = re.sub(rf"(?ms)^\[\[{section}\]\].*?(?=^\[|\Z)", "", TEXT)
    assert f"{section}: must be tables, each below a header [[{section}]]" in told(f'{section} = "x"\n{others}')
    assert f"{section}: must have 1 or more entries, but has 0" in told(f"{section} = []\n{others}")
