"""What thinning leaves out is made again from raw captures, as it would have been stored in a session."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from calibration.rig.decoding import without_decoding
from calibration.rig.description import parse_rig
from daemon.acquisition.link_decoders import LinkDecoders
from daemon.acquisition.redecoding import redecode, redecode_command
from daemon.acquisition.thinning import Thinning
from daemon.commands import CommandError
from daemon.composition import decoders
from daemon.config.config import parse_config
from daemon.rig_files import load_rig
from daemon.service import declare_channels
from daemon.store import Store
from daemon.store.errors import StoreError
from daemon.store.queries.sessions import SessionTable
from daemon.store.upkeep.full_samples import stretches_between
from daemon.store.upkeep.packing import Packing
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import Capture, Fix, Reading
from tests.bench.store_growth import CONFIG, UTC_0_NS, traffic
from tests.daemon.support.rig_files import ANOTHER_FACTOR, ANOTHER_ZERO, decoded_rig
from tests.daemon.support.store import table

SECONDS = 6.0
SOURCE = load_rig("swdt82")
DECODERS = decoders(parse_config(CONFIG, Path.cwd()), SOURCE)
_OTHER_TEXT = SOURCE.text.replace(*ANOTHER_ZERO)
OTHER = replace(SOURCE, rig=parse_rig(_OTHER_TEXT, "other"), text=_OTHER_TEXT)
OTHER_DECODERS = decoders(parse_config(CONFIG, Path.cwd()), OTHER)
TABLES = {
    "joint_samples": ("channel_id", "value", "status", "raw_counts"),
    "signals": ("channel_id", "value", "status"),
    "fixes": ("station", "status", "hz_angle_rad", "slope_distance_m"),
}


def at_fifth(stamp: Stamp) -> Stamp:
    """The fifth of a second that an instant lies in."""
    return stamp.shifted(-(stamp.monotonic_ns % (NS_PER_S // 5)))


@pytest.fixture(scope="module")
def sent() -> list[list[Capture]]:
    return list(traffic(SECONDS, 1))


def stored(path: Path, sent: list[list[Capture]], is_of_session: Callable[[Reading | Fix], bool]) -> Store:
    store = Store(path)
    declare_channels(store, SOURCE.rig)
    decoding, thinning = LinkDecoders(DECODERS), Thinning(is_of_session)
    for batch in sent:
        ids = store.append_captures(batch)
        with store.transaction():
            store.insert_records(thinning.kept(decoding.feed_and_tick(batch)))
            store.mark_decoded(ids)
    return store


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory, sent: list[list[Capture]]) -> Path:
    path = tmp_path_factory.mktemp("full") / "rigcal.sqlite"
    stored(path, sent, lambda _: True).close()
    return path


@pytest.fixture
def thinned(tmp_path: Path, sent: list[list[Capture]]) -> Iterator[Store]:
    with contextlib.closing(stored(tmp_path / "rigcal.sqlite", sent, lambda _: False)) as store:
        yield store


def facts(path: Path, name: str, since: Stamp, until: Stamp) -> set[tuple[Any, ...]]:
    return {
        (row["monotonic_ns"], *(row[column] for column in TABLES[name]))
        for row in table(path, name)
        if since.monotonic_ns <= row["monotonic_ns"] <= until.monotonic_ns
    }


def test_a_stretch_has_all_readings_and_fixes_again_and_each_once(full: Path, thinned: Store) -> None:
    while Packing(thinned).pack_next():
        pass
    since, until = (Stamp(UTC_0_NS + s * NS_PER_S, s * NS_PER_S, "bench") for s in (2, 4))
    before = {name: len(table(thinned.path, name)) for name in TABLES}
    assert before["joint_samples"] < 0.1 * len(table(full, "joint_samples"))
    added = redecode(thinned, DECODERS, [(since, until)])
    after = {name: len(table(thinned.path, name)) for name in TABLES}
    assert added == sum(after.values()) - sum(before.values()) > 1500
    for name in TABLES:
        assert facts(thinned.path, name, since, until) >= facts(full, name, since, until)
        rows = [(row["monotonic_ns"], row[TABLES[name][0]]) for row in table(thinned.path, name)]
        assert len(rows) == len(set(rows))
    assert redecode(thinned, DECODERS, [(since, until)]) == 0


def test_what_waits_to_be_decoded_for_the_first_time_is_not_stored_twice(
    tmp_path: Path, sent: list[list[Capture]]
) -> None:
    everything = {"first_utc_ns": UTC_0_NS, "last_utc_ns": UTC_0_NS + 10 * NS_PER_S}
    with contextlib.closing(Store(tmp_path / "rigcal.sqlite")) as store:
        declare_channels(store, SOURCE.rig)
        waiting = [(batch, store.append_captures(batch)) for batch in sent if batch]
        decoding, thinning = LinkDecoders(DECODERS), Thinning(lambda _: False)

        def decode(until_s: float) -> None:
            while waiting and waiting[0][0][0].stamp.monotonic_ns < until_s * NS_PER_S:
                batch, ids = waiting.pop(0)
                with store.transaction():
                    store.insert_records(thinning.kept(decoding.feed_and_tick(batch)))
                    store.mark_decoded(ids)

        decode(1.5)
        with pytest.raises(CommandError, match=r"waits to be decoded for the first time; try again when"):
            redecode_command(store, SOURCE.rig, DECODERS, everything, lambda: None)
        decode(4.0)
        result = redecode_command(store, SOURCE.rig, DECODERS, everything, lambda: None)
        assert result["added"] > 500
        assert not result["is_whole"]
        (stretch,) = result["stretches"]
        assert stretch["last_utc_ns"] - UTC_0_NS == pytest.approx(2.0 * NS_PER_S, abs=0.2 * NS_PER_S)
        decode(SECONDS)
        rest = redecode_command(store, SOURCE.rig, DECODERS, everything, lambda: None)
        assert (rest["added"] > 500, rest["is_whole"]) == (True, True)
    for name, columns in TABLES.items():
        rows = [(row["monotonic_ns"], row[columns[0]]) for row in table(store.path, name)]
        assert len(rows) == len(set(rows)), name


def test_a_fix_that_observations_name_keeps_its_row(thinned: Store) -> None:
    first = table(thinned.path, "fixes")[0]
    redecode(thinned, DECODERS, [(thinned.stamp(first), thinned.stamp(first).shifted(NS_PER_S))])
    assert table(thinned.path, "fixes")[0] == first


def test_a_time_of_the_wall_clock_is_found_and_one_without_captures_is_refused(thinned: Store) -> None:
    with thinned.reader() as reader:
        ((since, until),) = stretches_between(reader, UTC_0_NS + 2 * NS_PER_S, UTC_0_NS + 3 * NS_PER_S)
    assert abs(since.monotonic_ns - 2 * NS_PER_S) < 0.1 * NS_PER_S  # whole chunks, which are small ones yet
    assert abs(until.monotonic_ns - 3 * NS_PER_S) < 0.1 * NS_PER_S
    for arguments, said in (
        ({"session": "s009-x"}, "no captures of session 's009-x'"),
        ({"first_utc_ns": 1, "last_utc_ns": 2}, "no captures of the period from 1970"),
        ({"first_utc_ns": 2, "last_utc_ns": 1}, "whose end is later"),
    ):
        with pytest.raises(CommandError, match=said):
            redecode_command(thinned, SOURCE.rig, DECODERS, arguments, lambda: None)


def test_a_session_is_decoded_again_with_its_own_rig_file_alone(thinned: Store) -> None:
    first = table(thinned.path, "joint_samples")[0]
    SessionTable(thinned, SOURCE.rig.name).start(
        thinned.stamp(first), SOURCE.text, id="s001-r", prism="r", operator="", kind="check", note=""
    )
    before = table(thinned.path, "joint_samples")
    with pytest.raises(
        CommandError, match=r"s001-r was recorded with a rig file other than the one in use.*this one -2000"
    ):
        redecode_command(thinned, OTHER.rig, OTHER_DECODERS, {"session": "s001-r"}, lambda: None)
    assert table(thinned.path, "joint_samples") == before


def test_a_session_from_before_a_change_of_the_dbc_file_is_not_decoded_again(thinned: Store, tmp_path: Path) -> None:
    first = table(thinned.path, "joint_samples")[0]
    before, after = decoded_rig(tmp_path / "before"), decoded_rig(tmp_path / "after", ANOTHER_FACTOR)
    SessionTable(thinned, before.rig.name).start(
        thinned.stamp(first), before.text, id="s001-r", prism="r", operator="", kind="check", note=""
    )
    stored_signals = table(thinned.path, "signals")
    with pytest.raises(
        CommandError,
        match=r"s001-r was recorded with a rig file other than the one in use.* channel pump is decoded as ",
    ):
        redecode_command(
            thinned, after.rig, decoders(parse_config(CONFIG, tmp_path), after), {"session": "s001-r"}, lambda: None
        )
    assert table(thinned.path, "signals") == stored_signals


def test_a_session_that_does_not_tell_how_a_dbc_decoded_it_keeps_its_readings(thinned: Store, tmp_path: Path) -> None:
    """One that an earlier version has recorded."""
    before, after = decoded_rig(tmp_path / "before"), decoded_rig(tmp_path / "after", ANOTHER_FACTOR)
    early = without_decoding(before.text)
    stretch = Stamp(UTC_0_NS, 0, "bench"), Stamp(UTC_0_NS + 4 * NS_PER_S, 4 * NS_PER_S, "bench")
    SessionTable(thinned, before.rig.name).start(
        stretch[0], early, id="s001-r", prism="r", operator="", kind="check", note=""
    )
    redecode(thinned, decoders(parse_config(CONFIG, tmp_path), before), [stretch])
    stored_signals = table(thinned.path, "signals")
    with pytest.raises(StoreError, match=r"pump was \S+ \S+ and would now be .* a different rig file"):
        redecode_command(
            thinned, after.rig, decoders(parse_config(CONFIG, tmp_path), after), {"session": "s001-r"}, lambda: None
        )
    assert table(thinned.path, "signals") == stored_signals


def test_two_frames_of_one_instant_are_decoded_again_as_two(tmp_path: Path, sent: list[list[Capture]]) -> None:
    """An adapter hands over several at once, and logs have coarse stamps."""
    coarse = [[replace(one, stamp=at_fifth(one.stamp)) for one in batch] for batch in sent]
    with contextlib.closing(stored(tmp_path / "rigcal.sqlite", coarse, lambda _: True)) as store:
        before = len(table(store.path, "joint_samples"))
        assert (
            redecode(
                store, DECODERS, [(Stamp(UTC_0_NS, 0, "bench"), Stamp(UTC_0_NS + 9 * NS_PER_S, 9 * NS_PER_S, "bench"))]
            )
            == 0
        )
        assert len(table(store.path, "joint_samples")) == before


def test_readings_outside_sessions_are_not_made_others_by_another_rig_file(thinned: Store) -> None:
    stretch = Stamp(UTC_0_NS, 0, "bench"), Stamp(UTC_0_NS + 4 * NS_PER_S, 4 * NS_PER_S, "bench")
    before = table(thinned.path, "joint_samples")
    with pytest.raises(StoreError, match=r"L2 was \S+ mm and would now be \S+: .* a different rig file"):
        redecode(thinned, OTHER_DECODERS, [stretch])
    assert table(thinned.path, "joint_samples") == before


def test_in_a_session_of_the_rig_file_in_use_a_decoder_that_was_wrong_is_made_good(thinned: Store) -> None:
    first = table(thinned.path, "joint_samples")[0]
    SessionTable(thinned, SOURCE.rig.name).start(
        thinned.stamp(first), SOURCE.text, id="s001-r", prism="r", operator="", kind="check", note=""
    )
    redecode_command(thinned, SOURCE.rig, OTHER_DECODERS, {"session": "s001-r"}, lambda: None)
    redecode_command(thinned, SOURCE.rig, DECODERS, {"session": "s001-r"}, lambda: None)
    key = first["channel_id"], first["monotonic_ns"]
    again = [row for row in table(thinned.path, "joint_samples") if (row["channel_id"], row["monotonic_ns"]) == key]
    assert [row["value"] for row in again] == [first["value"]]
