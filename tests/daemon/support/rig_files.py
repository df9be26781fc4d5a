"""A rig of one's own in a directory, with the DBC and EDS files that it names."""

from __future__ import annotations

from pathlib import Path

from daemon.acquisition.channel_files import with_files
from daemon.rig_files import RigSource, load_rig

Change = tuple[str, str]
UNCHANGED = ("", "")
ENCODER = 'name = "theta1"\ndevice = "cia406_encoder"\n'
L2 = 'name = "L2"\ndevice = "cia406_linear"\nnode = 48\n'
ANOTHER_ZERO = (L2, f"{L2}zero_counts = -2000\n")
ANOTHER_FACTOR = ("SG_ P_Pump_bar : 0|16@1+ (0.1,0)", "SG_ P_Pump_bar : 0|16@1+ (0.01,0)")
_ENTRY = "[1A00sub1]\nParameterName=Map 1\nObjectType=0x7\nDataType=0x0007\nAccessType=rw\nDefaultValue="
ANOTHER_LENGTH = (f"{_ENTRY}0x60040020", f"{_ENTRY}0x60040010")


def own_rig(directory: Path, dbc: Change = UNCHANGED, eds: Change = UNCHANGED) -> RigSource:
    """Return swdt82 with an EDS file for theta1; `dbc` and `eds` change texts in the files that it names."""
    shipped = load_rig("swdt82")
    directory.mkdir(exist_ok=True)
    assert ENCODER in shipped.text
    (directory / "swdt82.toml").write_text(shipped.text.replace(ENCODER, f'{ENCODER}eds = "cia406.eds"\n'))
    for name, (old, new) in (("machine.dbc", dbc), ("cia406.eds", eds)):
        text = (shipped.directory / name).read_text(encoding="cp1252")
        assert old in text
        (directory / name).write_text(text.replace(old, new) if old else text, encoding="cp1252")
    return load_rig(str(directory / "swdt82.toml"))


def decoded_rig(directory: Path, dbc: Change = UNCHANGED, eds: Change = UNCHANGED) -> RigSource:
    """Return `own_rig` as the daemon runs it, with the decoding of its channels."""
    return with_files(own_rig(directory, dbc, eds))[0]
