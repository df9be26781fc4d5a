from __future__ import annotations

from pathlib import Path

import cantools.database
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.dbc import DbcFile
from drivers.can.raw_signal import SignalDecoder
from drivers.errors import DescriptionError
from drivers.readings import Gap, Status
from tests.drivers.can_support import DBC, START, at, the_reading


@pytest.fixture(scope="module")
def machine() -> DbcFile:
    return DbcFile(DBC)


def decoder(file: DbcFile, message: str, signal: str, unit: str = "x") -> SignalDecoder:
    return SignalDecoder(file.channel("signal", unit, message, signal))


def test_valve_currents_of_the_protocol_facts(machine: DbcFile) -> None:
    data = bytes.fromhex("E902C8FE0000B004")
    names = ("VC_Boom_mA", "VC_Arm_mA", "VC_Bucket_mA", "VC_Slew_mA")
    values = [the_reading(decoder(machine, "ValveCurrent1", name).decode(START, data)).value for name in names]
    assert values == [745.0, -312.0, 0.0, 1200.0]


def test_pressures_of_the_protocol_facts(machine: DbcFile) -> None:
    data = bytes.fromhex("3209140778005C05")
    names = ("P_Pump_bar", "P_BoomA_bar", "P_BoomB_bar", "OilTemp_C", "MsgCounter")
    values = [the_reading(decoder(machine, "Pressure1", name).decode(START, data)).value for name in names]
    assert values == pytest.approx([235.4, 181.2, 12.0, 52.0, 5.0])


def test_the_extended_identifier_of_the_protocol_facts(machine: DbcFile) -> None:
    channel = machine.channel("flow", "%", "AuxValve0Cmd", "PortFlowCmd_pct")
    assert (channel.arbitration_id, channel.is_extended) == (0x0CFE3021, True)
    data = bytes.fromhex("7DFF71FFFFFFFFFF")
    assert the_reading(SignalDecoder(channel).decode(START, data)).value == 50.0
    assert the_reading(decoder(machine, "AuxValve0Cmd", "ValveState").decode(START, data)).value == 1.0


@pytest.mark.parametrize(
    ("message", "signal", "data", "status"),
    [
        ("Pressure1", "P_Pump_bar", "FFFF000000000000", Status.NOT_AVAILABLE),
        ("Pressure1", "P_Pump_bar", "FEFF000000000000", Status.OUT_OF_RANGE),
        ("Pressure1", "OilTemp_C", "000000000000FF00", Status.NOT_AVAILABLE),
        ("Pressure1", "OilTemp_C", "000000000000FE00", Status.OUT_OF_RANGE),
        ("ValveCurrent1", "VC_Boom_mA", "0080000000000000", Status.OUT_OF_RANGE),
        ("ValveCurrent1", "VC_Boom_mA", "FFFF000000000000", Status.OK),
        ("AuxValve0Cmd", "PortFlowCmd_pct", "FF00000000000000", Status.NOT_AVAILABLE),
        ("AuxValve0Cmd", "PortFlowCmd_pct", "FE00000000000000", Status.NOT_AVAILABLE),
        ("AuxValve0Cmd", "PortFlowCmd_pct", "FB00000000000000", Status.OUT_OF_RANGE),
        ("AuxValve0Cmd", "ValveState", "00000F0000000000", Status.NOT_AVAILABLE),
    ],
)
def test_what_is_no_value_is_no_number(machine: DbcFile, message: str, signal: str, data: str, status: Status) -> None:
    assert the_reading(decoder(machine, message, signal).decode(START, bytes.fromhex(data))).status is status


def test_the_message_counter_is_found_by_its_name(machine: DbcFile) -> None:
    pump = decoder(machine, "Pressure1", "P_Pump_bar")
    frames = [bytes.fromhex(f"320914077800 5C0{count}".replace(" ", "")) for count in (5, 6, 9)]
    gaps = [r for n, data in enumerate(frames) for r in pump.decode(at(n * 0.01), data) if isinstance(r, Gap)]
    assert [gap.missed for gap in gaps] == [2]
    assert machine.channel("v", "mA", "ValveCurrent1", "VC_Boom_mA").counter is None
    assert machine.channel("c", "", "Pressure1", "MsgCounter").counter is None


@given(st.binary(min_size=8, max_size=8))
def test_values_agree_with_cantools(data: bytes) -> None:
    database = cantools.database.load_file(str(DBC))
    assert isinstance(database, cantools.database.can.Database)
    file = DbcFile(DBC)
    for message in database.messages:
        decoded = message.decode(data, decode_choices=False, allow_truncated=True)
        assert isinstance(decoded, dict)
        for name, value in decoded.items():
            reading = the_reading(decoder(file, message.name, name).decode(START, data))
            if reading.status is Status.OK:
                assert reading.value == pytest.approx(value)


TINY = """VERSION ""
BU_: A
BO_ 1 Mux: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" A
 SG_ First m0 : 8|16@0- (0.5,1) [0|0] "bar" A
 SG_ Second m1 : 8|8@1+ (1,0) [0|0] "bar" A
 SG_ Real : 32|32@1- (1,0) [0|0] "bar" A
BO_ 2 Long: 64 A
 SG_ S : 0|8@1+ (1,0) [0|0] "" A
BO_ 3 States: 8 A
 SG_ State : 0|4@1+ (1,0) [0|0] "" A
 SG_ CounterOne : 8|4@1+ (1,0) [0|0] "" A
 SG_ CounterTwo : 16|4@1+ (1,0) [0|0] "" A
 SG_ Lone : 24|8@0+ (1,0) [0|0] "" A
SIG_VALTYPE_ 1 Real : 1;
VAL_ 3 State 7 "not_available" 8 "SNA" 1 "error" ;
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "machine.dbc"
    path.write_text(text, encoding="cp1252")
    return path


def test_multiplexed_motorola_and_float_signals(tmp_path: Path) -> None:
    file = DbcFile(written(tmp_path, TINY))
    second = decoder(file, "Mux", "Second")
    assert the_reading(second.decode(START, bytes.fromhex("0122000000000000"))).value == 34.0
    assert second.decode(START, bytes.fromhex("0022000000000000")) == []
    assert the_reading(decoder(file, "Mux", "Real").decode(START, bytes.fromhex("0000000000002041"))).value == 10.0
    assert the_reading(decoder(file, "States", "Lone").decode(START, bytes(8))).status is Status.OK


def test_names_that_say_no_value_are_obeyed(tmp_path: Path) -> None:
    state = decoder(DbcFile(written(tmp_path, TINY)), "States", "State")
    values = [the_reading(state.decode(START, bytes((counts,)) + bytes(7))).value for counts in (1, 7, 8)]
    assert values == [1.0, None, None]


def test_two_counters_are_none(tmp_path: Path) -> None:
    assert DbcFile(written(tmp_path, TINY)).channel("s", "", "States", "State").counter is None


def test_a_message_of_can_fd_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match="message 'Long' has 64 bytes"):
        DbcFile(written(tmp_path, TINY)).channel("s", "", "Long", "S")


def test_a_multiplexer_behind_a_multiplexer_is_refused(tmp_path: Path) -> None:
    text = """VERSION ""
BU_: A
BO_ 1 Mux: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" A
 SG_ Inner m0M : 8|8@1+ (1,0) [0|0] "" A
 SG_ Deep m1 : 16|8@1+ (1,0) [0|0] "" A
SG_MUL_VAL_ 1 Inner Page 0-0;
SG_MUL_VAL_ 1 Deep Inner 1-1;
"""
    with pytest.raises(DescriptionError, match="nested multiplexers"):
        DbcFile(written(tmp_path, text)).channel("s", "", "Mux", "Deep")


def test_unknown_names_are_refused_with_those_that_are_known(machine: DbcFile) -> None:
    with pytest.raises(DescriptionError, match=r"has no message 'Pressure2'; messages: .*Pressure1, ValveCurrent1"):
        machine.channel("p", "bar", "Pressure2", "P")
    with pytest.raises(DescriptionError, match="has no signal 'P'; signals: ErrFlags, MsgCounter"):
        machine.channel("p", "bar", "Pressure1", "P")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('BO_ 512 X: 8 E\n SG_ A : 0|16@1- (1,0 [0|0] "" D\n', "line 2, column 23"),
        ("", "line 1, column 1"),
        ('VERSION ""\nBU_: A\nBO_ 1 X: 2 A\n SG_ S : 0|32@1+ (1,0) [0|0] "" A\n', "signal S does not fit in message X"),
        (
            'VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n SG_ S : 0|9@1+ (1,0) [0|0] "" A\n SG_ T : 0|8@1+ (1,0) [0|0] "" A\n',
            "overlapping",
        ),
        ('VERSION ""\nBU_: A\nBO_ one X: 8 A\n', "line 3"),
    ],
)
def test_a_malformed_file_is_refused_with_place_and_reason(tmp_path: Path, text: str, reason: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(DescriptionError, match=reason) as caught:
        DbcFile(path)
    assert str(caught.value).startswith(f"{path}: not a valid DBC file")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('BA_ "NoDef" BO_ 512 10;', "'NoDef'"),
        ('VAL_ 999 X 0 "a" ;', "unused VAL_ entries in DBC: VAL_ 999 X"),
        ("\x81", "line 30"),
    ],
)
def test_a_file_that_refers_to_nothing_is_refused(tmp_path: Path, line: str, reason: str) -> None:
    path = tmp_path / "machine.dbc"
    path.write_bytes(DBC.read_bytes() + line.encode("latin-1"))
    with pytest.raises(DescriptionError, match=f"not a valid DBC file: .*{reason}"):
        DbcFile(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"none\.dbc: cannot be read: No such file"):
        DbcFile(tmp_path / "none.dbc")


@pytest.mark.parametrize("numbers", ["(0,0)", "(1e400,0)", "(1,1e400)"])
def test_a_factor_that_makes_no_value_is_refused(tmp_path: Path, numbers: str) -> None:
    text = DBC.read_text(encoding="cp1252").replace(
        "SG_ P_Pump_bar : 0|16@1+ (0.1,0)", f"SG_ P_Pump_bar : 0|16@1+ {numbers}"
    )
    with pytest.raises(DescriptionError, match=r"signal 'P_Pump_bar': factor .* are not usable"):
        DbcFile(written(tmp_path, text)).channel("pump", "bar", "Pressure1", "P_Pump_bar")


def decoding(
    directory: Path, old: str = "", new: str = "", signal: tuple[str, str] = ("Pressure1", "P_Pump_bar")
) -> str:
    text = DBC.read_text(encoding="cp1252")
    assert old in text
    path = directory / "changed.dbc"
    path.write_text(text.replace(old, new) if old else text, encoding="cp1252")
    return DbcFile(path).decoding(*signal)


PUMP = "SG_ P_Pump_bar : 0|16@1+ (0.1,0)"


def test_how_a_signal_is_decoded_is_told_in_a_line(tmp_path: Path) -> None:
    assert decoding(tmp_path) == "frame 201h, 16 unsigned bits from intel bit 0, 0.1 * integer + 0.0 bar"
    flow = decoding(tmp_path, signal=("AuxValve0Cmd", "PortFlowCmd_pct"))
    assert flow == "frame 0CFE3021h, 8 unsigned bits from intel bit 0, 0.4 * integer + 0.0 %"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (PUMP, PUMP.replace("0.1", "0.01")),
        (PUMP, PUMP.replace(",0)", ",-1)")),
        (PUMP, PUMP.replace("0|16", "0|12")),
        (PUMP, PUMP.replace("0|16", "1|15")),
        (PUMP, PUMP.replace("@1+", "@1-")),
        (PUMP, PUMP.replace("0|16@1", "7|16@0")),
        ('[0|600] "bar" DAQ\n SG_ P_BoomA', '[0|600] "kPa" DAQ\n SG_ P_BoomA'),
        ("BO_ 513 P", "BO_ 514 P"),
        ("VAL_ ", 'VAL_ 513 P_Pump_bar 9 "SNA";\nVAL_ '),
    ],
    ids=["factor", "offset", "length", "start", "sign", "byte order", "unit", "identifier", "no value"],
)
def test_another_reading_of_the_same_frames_is_another_decoding(tmp_path: Path, old: str, new: str) -> None:
    assert decoding(tmp_path, old, new) != decoding(tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("@1- (1,0)", "@1- (2,0)"),
        ("SG_ P_BoomA_bar : 16|16@1+ (0.1,0)", "SG_ P_BoomA_bar : 16|16@1+ (0.01,0)"),
        ("[0|600]", "[0|700]"),
        ("MsgCounter", "Alive"),
        ("2365468705", "2365468706"),
        ('VERSION ""', 'VERSION "2"'),
        ("BU_: MachineECU DAQ", "BU_: MachineECU DAQ Other"),
    ],
    ids=["other message", "other signal", "range", "counter", "other identifier", "version", "nodes"],
)
def test_what_else_is_in_a_file_is_no_other_decoding(tmp_path: Path, old: str, new: str) -> None:
    assert decoding(tmp_path, old, new) == decoding(tmp_path)


def test_the_page_of_a_multiplexed_signal_is_part_of_its_decoding_however_many_it_has(tmp_path: Path) -> None:
    def told(*pages: int) -> str:
        ranges = ",".join(f"{page}-{page}" for page in pages)
        path = tmp_path / "pages.dbc"
        path.write_text(
            f'BO_ 1 M: 8 X\n SG_ page M : 0|8@1+ (1,0) [0|0] "" X\n SG_ a m{pages[0]} : 8|8@1+ (1,0) [0|0] "" X\n'
            f"SG_MUL_VAL_ 1 a page {ranges};\n"
        )
        return DbcFile(path).decoding("M", "a")

    assert told(1, 2).endswith("where 8 unsigned bits from intel bit 0 are 1 2")
    many = told(*range(200))
    assert "are 200 numbers (SHA-256 " in many
    assert many != told(*range(1, 201))
