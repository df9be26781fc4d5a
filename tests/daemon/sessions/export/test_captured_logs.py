"""A session's logs have one axis of time, on which captures of all links lie as they came."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.composition import decoders
from daemon.config.config import parse_config
from daemon.guide.times_away import times_away
from daemon.rig_files import load_rig
from daemon.sessions.export.captured_logs import CanFormat, export_session
from daemon.sessions.export.session_file import read_session_file
from daemon.sessions.replay import merged
from daemon.store.errors import StoreError
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import CanCapture, DeviceEvent, EventKind, Reading, SerialCapture
from tests.daemon.support.sessions import Rig

CONFIG = """
rig = "swdt82"
state_directory = "."
[[can]]
name = "boom"
channel = "can0"
[[station]]
name = "ts"
serial.path = "/dev/ttyS9"
profile = "passive"
"""
BEGIN = Stamp(1_795_800_000 * NS_PER_S, 5 * NS_PER_S, "boot-a")
REBOOT_S, END_S = 130, 250


def at_second(second: int, behind_s: int) -> Stamp:
    """The instant of a second of the session; after the reboot the computer's clock is behind."""
    if second < REBOOT_S:
        return BEGIN.shifted(second * NS_PER_S)
    since_ns = (second - REBOOT_S) * NS_PER_S
    return Stamp(BEGIN.utc_ns + (second - behind_s) * NS_PER_S, 20 * NS_PER_S + since_ns, "boot-b")


def heard(*, is_silent: bool) -> list[int]:
    """Seconds in which a link had a capture; one that is silent had none in the two minutes before the reboot."""
    until = 20 if is_silent else REBOOT_S - 10
    return [*range(1, until), *range(REBOOT_S + 1, END_S)]


def with_a_session(path: Path) -> Rig:
    """A rig whose session `s1` has begun."""
    rig = Rig(path)
    rig.clock.set(BEGIN)
    rig.store.begin_run(BEGIN)
    rig.say("setup_new", id="S1")
    rig.say("start", prism="r", id="s1")
    return rig


def close(rig: Rig) -> None:
    """End its session, its run and its store."""
    rig.say("stop")
    rig.store.end_run(rig.clock.now())
    rig.store.close()


@pytest.mark.parametrize("can_format", ["log", "asc", "blf"])
@pytest.mark.parametrize("behind_s", [0, 3600])
@pytest.mark.parametrize("silent", ["boom", "ts"])
def test_a_link_that_fell_silent_before_a_reboot_comes_beside_the_others_of_the_same_second(
    tmp_path: Path, can_format: CanFormat, behind_s: int, silent: str
) -> None:
    boom, ts = (heard(is_silent=silent == link) for link in ("boom", "ts"))
    config = parse_config(CONFIG, tmp_path / "rigcal.toml")
    rig = with_a_session(config.store_path)
    for seconds in (range(1, REBOOT_S - 9), range(REBOOT_S + 1, END_S)):
        stamps = {second: at_second(second, behind_s) for second in seconds}
        rig.clock.set(stamps[seconds[0]])
        rig.store.begin_run(rig.clock.now())
        frames = [CanCapture("boom", at, 0x1A0, bytes([n])) for n, at in stamps.items() if n in boom]
        lines = [SerialCapture("ts", at, b"%d\r\n" % n) for n, at in stamps.items() if n in ts]
        rig.store.mark_decoded([*rig.store.append_captures(frames), *rig.store.append_captures(lines)])
    rig.clock.set(at_second(END_S, behind_s))
    close(rig)
    logs = [
        path for path in export_session(config, "s1", tmp_path / "out", can_format, times_away) if path.suffix != ".csv"
    ]
    told = read_session_file(logs.pop())
    came: dict[str, list[int]] = {"boom": [], "ts": []}
    apart = []
    for capture in merged(logs, config, told):
        second = capture.data[0] if isinstance(capture, CanCapture) else int(capture.data)
        came[capture.link].append(second)
        if second > REBOOT_S and all(came.values()):
            apart.append(max(abs(second - seconds[-1]) for seconds in came.values() if seconds[-1] > REBOOT_S))
    assert came == {"boom": boom, "ts": ts}
    assert max(apart) <= 1


@pytest.mark.parametrize("behind_s", [0, 7200])
def test_a_joint_that_moved_while_the_computer_was_off_has_not_jumped_in_a_replay(
    tmp_path: Path, behind_s: int
) -> None:
    config = parse_config(CONFIG, tmp_path / "rigcal.toml")
    rig = with_a_session(config.store_path)
    for boot, degrees in ((range(1, 120), 10.0), (range(3730, 3850), 100.0)):
        stamps = [at_second(second, behind_s) for second in boot]
        rig.clock.set(stamps[0])
        rig.store.begin_run(rig.clock.now())
        counts = round(20_000 + degrees / 360 * 65_536).to_bytes(4, "little")
        rig.store.mark_decoded(rig.store.append_captures([CanCapture("boom", at, 0x1A0, counts) for at in stamps]))
        rig.clock.set(stamps[-1])
    close(rig)
    logs = [path for path in export_session(config, "s1", tmp_path / "out", "log", times_away) if path.suffix != ".csv"]
    told = read_session_file(logs.pop())
    decoder = decoders(config, load_rig("swdt82"))["boom"]()
    records = [record for capture in merged(logs, config, told) for record in decoder.feed(capture)]
    assert sum(isinstance(record, Reading) for record in records) == 239
    assert [record for record in records if isinstance(record, DeviceEvent)] == []


def test_a_damaged_store_leaves_no_part_of_a_session_s_logs(tmp_path: Path) -> None:
    config = parse_config(CONFIG, tmp_path / "rigcal.toml")
    rig = with_a_session(config.store_path)
    for second in (1, 2):
        (chunk,) = rig.store.append_captures([CanCapture("boom", at_second(second, 0), 0x1A0, bytes([second]))])
        rig.store.mark_decoded([chunk])
    rig.clock.set(at_second(3, 0))
    rig.store.update("raw_chunks", {"id": chunk}, {"chunk": b"rust"})
    close(rig)
    with pytest.raises(StoreError, match=f"raw chunk {chunk}"):
        export_session(config, "s1", tmp_path / "out", "log", times_away)
    assert [*(tmp_path / "out").iterdir()] == []


def test_the_set_up_of_an_earlier_boot_comes_before_the_session_s_logs(tmp_path: Path) -> None:
    config = parse_config(CONFIG, tmp_path / "rigcal.toml")
    rig = Rig(config.store_path)
    ahead = Stamp(BEGIN.utc_ns + 3600 * NS_PER_S, 900 * NS_PER_S, "boot-0")  # a clock that was wrong
    set_up = DeviceEvent("theta1", ahead, EventKind.CONFIGURED, "theta1 (node 32): configured and started")
    rig.store.insert_records([set_up])
    rig.store.close()
    rig = with_a_session(config.store_path)
    rig.store.mark_decoded(rig.store.append_captures([CanCapture("boom", at_second(61, 0), 0x1A0, b"1")]))
    rig.clock.set(at_second(62, 0))
    close(rig)
    (session,) = [p for p in export_session(config, "s1", tmp_path / "out", "log", times_away) if p.suffix == ".json"]
    states = read_session_file(session).device_states
    assert [state.kind for state in states] == [EventKind.CONFIGURED]
    assert states[0].utc_ns < BEGIN.utc_ns
