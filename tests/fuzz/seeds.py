"""Makes the seeds of the corpus anew (`python -m tests.fuzz.seeds`): golden logs, shipped files, small models.

Seeds are called `seed-*`; inputs that found a fault have other names, and stay.
"""

from __future__ import annotations

import io
import json
import re
import struct
import sys
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from calibration.identification.search.checkpoint import pack
from calibration.model.files import model_to_files
from calibration.observations import parse_observations
from calibration.pipeline.calibrate import calibrate
from daemon.models.first_load import encode
from daemon.rig_files import load_rig
from daemon.sessions.export.session_file import SessionFile
from daemon.store.captures import encode_captures
from daemon.store.packed_captures import CaptureColumns, packed
from drivers.logs.can_log import read_can_log, write_can_log
from drivers.logs.serial_log import read_serial_log
from drivers.readings import CanCapture, SerialCapture
from tests.calibration.rig.exchange import test_from_table, test_from_urdf
from tests.daemon.support.offline import held_out_csv, train_csv
from tests.drivers.stations.exports import test_exports
from tests.fuzz.streams import pack_frames, pack_pieces
from tests.fuzz.target import CORPUS
from tests.fuzz.targets.control import commands
from tests.fuzz.targets.models import sealed

_GOLDEN = Path(__file__).parents[1] / "golden" / "simulated"
_RIGS = Path(__file__).parents[2] / "calibration" / "rigs"
_MORE_RIGS = Path(__file__).parents[1] / "rigs"
_PROFILES = {"topcon_gts8": 0, "classic-pushed": 1, "sokkia-pushed": 3}
_FRAMES, _PIECES = 60, 60
_TREES = 4


def _frames(folder: Path, count: int = _FRAMES) -> list[CanCapture]:
    return list(islice(read_can_log(folder / "boom.log"), count))


def _serial(folder: Path) -> list[SerialCapture]:
    return list(islice(read_serial_log(folder / "station.serial"), _PIECES))


def _with_pauses(captures: list[SerialCapture]) -> Iterator[tuple[int, bool, bytes]]:
    before = captures[0].stamp
    for capture in captures:
        yield capture.stamp.since(before), capture.is_transmitted, capture.data
        before = capture.stamp


def seeds() -> Iterator[tuple[str, str, bytes]]:
    """(target, name, input)."""
    yield from _of_logs()
    yield from _of_frames()
    yield from _of_descriptions()
    yield from _of_texts()
    yield from _of_imports()
    yield from _of_stored()
    yield from _of_models()
    for number, command in enumerate(commands()):
        yield "control", f"{number:02d}-{command['command']}", json.dumps(command).encode()


def _of_logs() -> Iterator[tuple[str, str, bytes]]:
    for folder in sorted(path for path in _GOLDEN.iterdir() if (path / "boom.log").is_file()):
        frames, pieces = _frames(folder), _serial(folder)
        received = b"".join(capture.data for capture in pieces if not capture.is_transmitted)
        is_sokkia = folder.name.startswith("sokkia")
        yield "sokkia" if is_sokkia else "topcon", folder.name, received[:1500]
        profile = next((number for name, number in _PROFILES.items() if name == folder.name), 0)
        stream = pack_pieces(_with_pauses(pieces))
        yield "station-decoder", folder.name, bytes([profile]) + stream
        yield "conversation", folder.name, bytes([profile]) + stream
        yield "can-decoder", folder.name, pack_frames(frames)
        yield "node-supervision", folder.name, pack_frames(f for f in frames if len(f.data) <= 8)[:400]
        yield "log-candump", folder.name, _lines(folder / "boom.log", 25)
        yield "log-serial", folder.name, _lines(folder / "station.serial", 25)
        for number, chunk in enumerate(encode_captures([*frames[:20], *pieces[:10]])):
            yield "captures", f"{folder.name}-{number}", chunk.blob
    errors = [c for c in read_can_log(_GOLDEN / "bus-errors" / "boom.log") if c.is_error]
    yield "can-errors", "bus-errors", pack_frames(errors)
    yield "can-decoder", "errors-alone", pack_frames(errors)
    emergencies = [c for c in read_can_log(_GOLDEN / "node-faults" / "boom.log") if 0x80 < c.arbitration_id < 0x100]
    yield "node-supervision", "emergencies", pack_frames(emergencies[:20])
    scratch = CORPUS / "scratch"
    for suffix in ("asc", "blf"):
        written = scratch.with_suffix(f".{suffix}")
        write_can_log(written, [*_frames(_GOLDEN / "standing", 20), *errors[:3]])
        data = written.read_bytes()
        written.unlink()
        yield f"log-{suffix}", "written", data
    yield "log-blf", "classic-in-fd-objects", _blf_with_fd_objects()


def _blf_with_fd_objects() -> bytes:
    """One container, not compressed, with a classic frame in a CAN FD object of either kind, and an error frame."""
    stamp = struct.pack("<L4xQ", 2, 1_000_000)
    bodies = {
        100: struct.pack("<HBBLLBBB5x64s", 1, 0, 2, 0x1A0, 0, 0, 0, 2, b"\1\2"),
        101: struct.pack("<BBBBLLLLLLLHBBL", 1, 2, 2, 0, 0x1A0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0) + b"\1\2\0\0\0\0\0\0",
        73: struct.pack("<HHLBBBxLLH2x8s", 1, 0, 0, 0, 0, 0, 0, 0x20000004, 0, b""),
    }
    objects = b""
    for kind, body in bodies.items():
        data = struct.pack("<4sHHLL", b"LOBJ", 32, 1, 32 + len(body), kind) + stamp + body
        objects += data + bytes(len(data) % 4)
    content = struct.pack("<H6xL4x", 0, len(objects)) + objects
    container = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(content), 10) + content
    dates = (2023, 11, 2, 14, 22, 13, 20, 0) * 2
    head = struct.pack(
        "<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1, 144 + len(container), 0, 3, 3, *dates
    )
    return head.ljust(144, b"\0") + container


def _of_frames() -> Iterator[tuple[str, str, bytes]]:
    yield "can-frame", "data", struct.pack("=IB3x8s", 0x1A0, 8, bytes(range(8)))
    yield "can-frame", "extended", struct.pack("=IB3x8s", 0x80000000 | 0x0CFE3021, 8, bytes(8))
    yield "can-frame", "error", struct.pack("=IB3x8s", 0x20000004, 8, bytes(8))
    message: dict[str, Any] = {"timestamp": 1.0, "arbitration_id": 0x1A0, "is_extended_id": False, "data": bytes(8)}
    message |= {"is_remote_frame": False, "is_error_frame": False, "channel": None, "dlc": 8, "is_fd": False}
    yield "can-multicast", "data", msgpack.packb(message | {"bitrate_switch": False, "error_state_indicator": False})
    yield "can-slcan", "lines", b"t1A080011223344556677\rT0CFE30212AABB\rr1A00\rR0CFE30210\rz\rV1013\r\at20121122ABCD\r"
    yield "j1939", "identifier", (0x18FEEE00).to_bytes(5, "little")
    yield "tip-frames", "ok", struct.pack("<BBIddddd", 0, 7, 300, 1000.0, -2000.0, 3000.0, 4.5, 0.02)
    expedited, segment = (
        b"\x43\x18\x10\x01\1\2\3\4",
        b"\x41\x18\x10\x01\x0a\0\0\0" + b"\x00abcdefg" + b"\x19hij\0\0\0\0",
    )
    yield "sdo", "expedited", b"\0" + expedited
    yield "sdo", "segments", b"\0" + segment
    yield "sdo", "abort", b"\x80" + b"\x80\x17\x10\x00\0\0\2\6"
    yield "node-setup", "silent", b"\x87" + b"\xff" * 60
    answers = (0x196, 1, 2, 3, 4, 65536, 268435456, 0, 0, 0, 0, 0, 0x1A0, 1, 0x60040020, 1, 255, 0, 0)
    sound = b"".join(b"\0" + number.to_bytes(4, "little") for number in answers)
    yield "node-setup", "sound", sound + b"\4" * 12 + sound
    yield "node-setup", "absent", b"\0" + (0x196).to_bytes(4, "little") + b"\6" * 12 + sound[60:]


def _of_descriptions() -> Iterator[tuple[str, str, bytes]]:
    for path in sorted(_RIGS.glob("*.toml")) + sorted(_MORE_RIGS.glob("*.toml")):
        yield "rig", path.stem, path.read_bytes()
    yield "dbc", "machine", (_RIGS / "machine.dbc").read_bytes()
    yield "dbc", "tip", (_RIGS.parents[1] / "drivers" / "can" / "tip.dbc").read_bytes()
    yield "dbc", "multiplexed", _MULTIPLEXED
    yield "eds", "cia406", (_RIGS / "cia406.eds").read_bytes()
    yield "eds", "arrays", _ARRAYS


_MULTIPLEXED = b"""VERSION ""

NS_ :

BS_:

BU_: A B

BO_ 2566844926 X: 8 A
 SG_ M M : 0|8@1+ (1,0) [0|0] "" B
 SG_ N m0M : 8|8@1+ (1,0) [0|0] "" B
 SG_ a m0 : 16|16@1- (0.1,-40) [-40|250] "degC" B
 SG_ b m1 : 7|16@0+ (1,0) [0|0] "" B
 SG_ f m2 : 32|32@1- (1,0) [0|0] "" B
 SG_ alive : 56|4@1+ (1,0) [0|15] "" B

CM_ SG_ 2566844926 a "a \\"comment\\"";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ "BusType" STRING ;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "BusType" "CAN";
BA_ "GenMsgCycleTime" BO_ 2566844926 100;
VAL_ 2566844926 b 0 "off" 255 "SNA" ;
SIG_VALTYPE_ 2566844926 f : 1;
SG_MUL_VAL_ 2566844926 N M 0-0;
SG_MUL_VAL_ 2566844926 a N 0-3, 7-7;
"""
_ARRAYS = b"""[FileInfo]
FileName=x.eds
[DeviceInfo]
VendorName=x
BaudRate_250=1
[DummyUsage]
Dummy0001=0
Dummy0002=1
Dummy0003=1
Dummy0004=1
Dummy0005=1
Dummy0006=1
Dummy0007=1
[Comments]
Lines=1
Line1=x
[1800]
ParameterName=TPDO1
ObjectType=0x9
SubNumber=2
[1800sub0]
ParameterName=n
DataType=0x5
AccessType=const
DefaultValue=2
[1800sub1]
ParameterName=id
DataType=0x7
AccessType=rw
DefaultValue=$NODEID+0x180
LowLimit=0x1
HighLimit=0xFFFFFFFF
[1A00]
ParameterName=mapping
ObjectType=0x8
DataType=0x7
AccessType=rw
CompactSubObj=2
DefaultValue=0x60040020
[1A00Name]
NrOfEntries=1
1=first
"""


def _of_texts() -> Iterator[tuple[str, str, bytes]]:
    for folder in ("standing", "sokkia-pushed"):
        yield "config", folder, (_GOLDEN / folder / "rigcal.toml").read_bytes()
    yield "config", "everything", _CONFIG
    yield "config", "upkeep", _UPKEEP
    yield "rig", "signals", load_rig("swdt82").rig.with_signals("tilt_x_deg", "hose_bar").text.encode()
    yield "plan", "swdt82", _plan()
    yield "observations", "ur10", b"".join(held_out_csv().splitlines(keepends=True)[:8])
    yield "observations", "everything", _OBSERVATIONS
    session = {
        "prism": "r",
        "kind": "check",
        "since_utc_ns": 1,
        "until_utc_ns": 2,
        "control_points": {"cp1": (1.0, 2.0, 3.0)},
    }
    yield "session-file", "check", SessionFile.model_validate(session).model_dump_json().encode()


_CONFIG = b"""rig = "swdt82"
state_directory = "/tmp/rigcal"
socket = "/tmp/rigcal/control.sock"

[[can]]
name = "boom"
interface = "socketcan"
channel = "can0"
bitrate = 250000
allow_transmit = true
transmit_nodes = [32, 33]
sync_period_ms = 100.0
options = {}

[[station]]
name = "station"
profile = "sokkia_set"
init = ["Xe"]
crlf = false
poll_interval_s = 0.5
link_delay_s = 0.05
serial = { path = "/dev/ttyUSB0", baud = 9600 }

[sessions]
settle_s = 1.0
fixes_per_shot = 3

[jobs]
enabled = true
time_limit_s = 60.0

[tip]
prism = "r"
rate_hz = 5.0
can = { link = "boom", arbitration_id = 0x680 }
"""
_OBSERVATIONS = b"""\xef\xbb\xbfprism,setup,session,pose,time_s,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,\
x_mm,y_mm,z_mm,\
sigma_x_mm,sigma_y_mm,sigma_z_mm,q1_dir,q1_rate,q1_Nm,dwell_s,temperature_degC,payload_kg,boom_bar,valve_mA,other\r
tmac,S1,a,1,0.5,1,2,3,4,5,6,1000,2000.5,-300,0.1,0.1,0.1,1,0.5,10,3,20,5,100,5,x\r
"tmac",S1,a,"2\xc3\xa9",1.5,1,2,3,4,5,7,1000,2000.5,-3e2,,,,-1,,,,,,,,"a ""b"",\nc"\r
"""


_UPKEEP = b"""rig = "swdt82"
state_directory = "/tmp/rigcal"

[store]
keep_days = 30
free_gb = 5.0
backup_directory = "/mnt/backup"

[metrics]
port = 9464

[notify]
webhook_url = "https://chat.example/hook?token=a"
command = ["/usr/bin/msmtp", "someone@example.com"]
least = "critical"
"""


def _plan() -> bytes:
    joints = load_rig("swdt82").rig.joints
    head = [*(joint.column for joint in joints), "theta1_dir", "dwell_s"]
    poses = [
        [*(f"{low + share * (high - low):.3f}" for low, high in (j.limits for j in joints))] for share in (0.3, 0.6)
    ]
    return "\n".join(",".join(row) for row in (head, [*poses[0], "1", ""], [*poses[1], "-1", "7.5"])).encode()


def _of_imports() -> Iterator[tuple[str, str, bytes]]:
    yield "urdf", "mixed", test_from_urdf.MIXED.encode()
    yield "dh-table", "ur10", test_from_table.UR10.encode()
    yield (
        "dh-table",
        "sum",
        b"joint,a_mm,theta_drive,lower,upper,max_rate\nq1,100,,-90,90,5\nq2,100,,,,\n,100,-q1 + 0.5*q2,,,\n",
    )
    exports = {
        "gts": test_exports.gts_download(),
        "sdr": test_exports.SDR_HEAD + test_exports.sdr("09F1", "0003", "0004", 10.0, 100.0, 50.0, "r"),
        "leica": test_exports.LEICA,
        "faro": test_exports.FARO,
        "vicon": test_exports.VICON,
        "angles": test_exports.ANGLES,
    }
    for name, text in exports.items():
        yield "exports", name, text.encode()
    yield "import-map", "written", _MAP
    for key, cells in {
        "pose": ("P1", "P2"),
        "time_s": ("0.0", "0.5"),
        "time": ("2026-11-24T10:00:00Z", "2026-11-24T10:00:01Z"),
    }.items():
        head = f"{key},q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n"
        yield "joint-values", key, (head + "".join(f"{cell},1,2,3,4,5,6.5\n" for cell in cells)).encode()


_MAP = b"""format = "leica_csv"
separator = ","
header_line = 1
first_line = 2
length_unit = "m"

[columns]
point = "PtID"
x = "East [m]"
y = "North [m]"
z = "Height [m]"
prism = "Code"
date = "Date/Time"

[prisms]
w = "tool"
"""


def _packed(*, is_serial: bool) -> bytes:
    count, payload = 12, np.arange(96, dtype=np.uint8)
    columns = CaptureColumns(
        monotonic_ns=np.arange(count, dtype=np.int64) * 200_000_000,
        utc_ns=np.arange(count, dtype=np.int64) * 200_000_000 + 10**18,
        identifier=np.tile(np.array([0x1A0, 0x1A1], dtype=np.uint32), count // 2),
        flags=np.zeros(count, dtype=np.uint8),
        length=np.full(count, 8, dtype=np.uint32),
        payload=payload,
    )
    return bytes([is_serial]) + count.to_bytes(2, "little") + packed(columns, is_serial=is_serial)


def _of_stored() -> Iterator[tuple[str, str, bytes]]:
    arrays = io.BytesIO()
    np.savez(arrays, a=np.eye(3), names=np.array(["x", "y"]), f=np.asfortranarray(np.ones((2, 3))))
    yield "backup", "daily", b'{"form": 1, "made_utc_ns": 1790000000000000000, "size_bytes": 4096, "rigcal": "0.2.0"}'
    for is_serial in (False, True):
        yield "packed-captures", "serial" if is_serial else "can", _packed(is_serial=is_serial)
    yield "npz", "saved", arrays.getvalue()
    compressed = io.BytesIO()
    np.savez_compressed(compressed, a=np.eye(3))
    yield "npz", "compressed", compressed.getvalue()
    yield "checkpoint", "saved", pack({"seed": np.array("1"), "data": np.zeros(3)}, {"population": np.ones((4, 2))})
    for number, message in enumerate(({"progress": 0.5, "message": "a"}, {"result": {"model": "x"}}, {"error": "why"})):
        yield "job-message", str(number), json.dumps(message).encode()


def _of_models() -> Iterator[tuple[str, str, bytes]]:
    source = load_rig("ur10")
    observations = parse_observations(train_csv(), source.rig, "train.csv")
    for residual in ("none", "rbfn", "lightgbm", "gp"):
        model, _ = calibrate(source.rig, source.text, observations, effects="none", residual=residual)
        files = model_to_files(model)
        for name in [name for name in files if name.startswith("lightgbm_")]:
            files[name] = _few_trees(files[name])
        yield "model", residual, encode(sealed(files))
        if residual == "lightgbm":
            yield "trees", "x", files["lightgbm_x.txt"]


def _few_trees(text: bytes) -> bytes:
    """LightGBM's text with its first trees alone."""
    head, *trees = re.split(rb"(?=^Tree=\d+$)", text, flags=re.MULTILINE)
    _, end = trees[-1].split(b"end of trees", 1)
    sizes = b" ".join(b"%d" % len(tree) for tree in trees[:_TREES])
    head = re.sub(rb"^tree_sizes=.*$", b"tree_sizes=" + sizes, head, flags=re.MULTILINE)
    return head + b"".join(trees[:_TREES]) + b"end of trees" + re.sub(rb"(?s)parameters:.*end of parameters", b"", end)


def _lines(path: Path, count: int) -> bytes:
    return b"".join(path.read_bytes().splitlines(keepends=True)[:count])


def main(only: Iterable[str]) -> None:
    wanted = set(only)
    for target, name, data in seeds():
        if not wanted or target in wanted:
            folder = CORPUS / target
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"seed-{name}").write_bytes(data)


if __name__ == "__main__":
    main(sys.argv[1:])
