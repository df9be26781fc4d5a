"""A backup is whole, verified, and can be put back; a damaged or a newer one never takes a good store's place."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.store import Reader, Store, StoreBusyError, StoreError
from daemon.store.queries.sessions import SessionTable
from daemon.store.upkeep import daily_backups
from daemon.store.upkeep.backup import backups, make_backup, restore_backup
from daemon.store.upkeep.daily_backups import DailyBackups
from daemon.store.upkeep.housekeeping import Housekeeping, Keeping
from daemon.store.upkeep.soundness import MANIFEST, check_store
from drivers.clock import NS_PER_S, ManualClock
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.damage import small_disk
from tests.daemon.support.store import BOOT, UTC_0, at, frame, table

MODEL = Path("00001-gap", "model")  # where a gap job writes its model, beside its report


def nothing() -> None:
    pass


class Site:
    """A state directory with a store and a live model, and a directory of backups."""

    def __init__(self, directory: Path) -> None:
        self.path, self.models = directory / "state" / "rigcal.sqlite", directory / "state" / "models"
        self.backups = directory / "backups"
        self.path.parent.mkdir()
        self.store = Store(self.path)
        for n in range(20):
            self.store.mark_decoded(self.store.append_captures([frame(n)]))
        model = self.models / MODEL
        model.mkdir(parents=True)
        (model / MANIFEST).write_text('{"a": 1}')
        (model / "model.json").write_text("{}")
        (self.models / ".rigcal-x").mkdir()  # one that is being written
        manifest = hashlib.sha256((model / MANIFEST).read_bytes()).hexdigest()
        row = {"rig": "swdt82", "path": str(model), "manifest_sha256": manifest, "stage": "hybrid", "state": "live"}
        self.store.insert("models", row | self.store.instant(at(0.0), "created_"))

    def back_up(self, day: int = 0, keep: int = 3) -> Path:
        return make_backup(self.path, self.models, self.backups, keep, UTC_0 + day * 86_400 * NS_PER_S, nothing).path

    def restore(self, backup: Path) -> Path | None:
        return restore_backup(backup, self.path, self.models, UTC_0, nothing)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    yield site
    site.store.close()


def captures(path: Path) -> int:
    with Reader(path) as reader:
        return len(list(reader.captures()))


def test_a_backup_of_a_store_that_is_written_to_is_restored_with_its_live_model(site: Site) -> None:
    stop = threading.Event()

    def write() -> None:
        while not stop.is_set():
            site.store.append_captures([frame(99)])

    writing = threading.Thread(target=write)
    writing.start()
    try:
        backup = site.back_up()
    finally:
        stop.set()
        writing.join()
    assert {path.name for path in backup.iterdir()} == {"rigcal.sqlite", "models", "backup.json"}
    assert {path.name for path in (backup / "models").iterdir()} == {"00001-gap"}
    held = captures(backup / "rigcal.sqlite")
    assert 20 <= held <= captures(site.path)
    site.store.close()
    shutil.rmtree(site.models)
    site.path.write_bytes(b"rust")
    aside = site.restore(backup)
    assert aside is not None
    assert (aside / "rigcal.sqlite").read_bytes() == b"rust"
    assert check_store(site.path, site.models).findings == ()
    assert (site.models / MODEL / "model.json").read_text() == "{}"
    with contextlib.closing(Store(site.path)) as again:
        assert again.number("SELECT sum(captures) FROM raw_chunks", []) == held


def test_a_session_that_was_open_when_the_backup_was_made_does_not_go_on(site: Site) -> None:
    site.store.begin_run(at(0.0))
    sessions = SessionTable(site.store, "swdt82")
    sessions.start(at(10.0), "name = 'swdt82'", id="s001-r", prism="r", operator="", kind="static_poses")
    site.store.note_alive(at(20.0))
    backup = site.back_up()
    sessions.change("s001-r", state="closed", **site.store.instant(at(30.0), "ended_"))
    sessions.start(at(40.0), "name = 'swdt82'", id="s002-b", prism="b", operator="", kind="static_poses")
    site.store.close()
    site.restore(backup)
    (session,) = table(site.path, "calibration_sessions")
    assert (session["id"], session["state"], session["ended_monotonic_ns"]) == (
        "s001-r",
        "closed",
        at(20.0).monotonic_ns,
    )
    assert "open in the backup" in session["excluded"]


def test_a_backup_that_nobody_may_change_is_restored_as_a_store_that_its_owner_may_write(site: Site) -> None:
    backup = site.back_up()
    site.store.close()
    for path in (backup, *backup.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    site.restore(backup)
    modes = [path.stat().st_mode for path in (site.path, site.models, *site.models.rglob("*"))]
    assert all(mode & 0o200 for mode in modes)


def test_a_restore_that_was_broken_off_is_made_again_whatever_it_has_left(site: Site) -> None:
    backup = site.back_up()
    site.store.close()
    left = site.path.parent / ".rigcal-restore.unfinished"
    left.mkdir()
    (left / "broken").symlink_to("nowhere")
    left.chmod(0o555)
    site.restore(backup)
    assert not left.exists()


def test_what_was_replaced_is_kept_though_it_was_within_the_same_second(site: Site) -> None:
    backup = site.back_up()
    site.store.close()
    site.path.write_bytes(b"rust")
    first, second = site.restore(backup), site.restore(backup)
    assert first is not None
    assert second is not None
    assert first != second
    assert (first / "rigcal.sqlite").read_bytes() == b"rust"


# Kills itself before a rename, its last argument: those of what is replaced, in turn, and of what takes its place.
KILLED = """
import os, signal, sys
from pathlib import Path
from daemon.store.upkeep.backup import restore_backup
backup, store, models = map(Path, sys.argv[1:4])
left = [int(sys.argv[4])]
rename = Path.rename
def counted(self, target):
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left[0] -= 1
    return rename(self, target)
Path.rename = counted
restore_backup(backup, store, models, 0, lambda: None)
"""


@pytest.mark.parametrize("renames", range(6))
def test_a_restore_that_was_killed_is_known_and_goes_on(site: Site, renames: int) -> None:
    backup = site.back_up()
    frames = captures(site.path)
    site.store.mark_decoded(site.store.append_captures([frame(99)]))
    site.store.close()
    for name in ("rigcal.sqlite-wal", "rigcal.sqlite-shm"):  # as a daemon leaves them that was killed too
        site.path.with_name(name).touch()
    command = [sys.executable, "-c", KILLED, *map(str, (backup, site.path, site.models, renames))]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    with pytest.raises(StoreError, match=rf"was interrupted.*`rigcal store restore {backup}` again"):
        Store(site.path)
    aside = site.restore(backup)
    assert aside is not None
    assert sorted(aside.parent.glob("replaced-*")) == [aside]
    assert captures(aside / "rigcal.sqlite") == frames + 1
    assert (aside / "models" / ".rigcal-x").is_dir()
    left = {path.name for path in site.path.parent.iterdir()}
    assert left == {"rigcal.sqlite", "rigcal.sqlite.lock", "models", aside.name}
    Store(site.path).close()
    assert captures(site.path) == frames


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, as on a rig")
def test_what_root_restores_belongs_to_the_service(site: Site) -> None:
    backup = site.back_up()
    site.store.close()
    os.chown(site.path.parent, 4711, 4712)
    site.restore(backup)
    restored = [site.path, site.models, *site.models.rglob("*")]
    assert {(path.stat().st_uid, path.stat().st_gid) for path in restored} == {(4711, 4712)}


def test_backups_are_not_kept_among_the_models_that_they_hold(site: Site) -> None:
    with pytest.raises(StoreError, match="would be part of every backup"):
        make_backup(site.path, site.models, site.models / "backups", 3, UTC_0, nothing)
    assert not (site.models / "backups").exists()


def test_nothing_is_restored_under_a_running_daemon(site: Site) -> None:
    backup = site.back_up()
    before = table(site.path, "raw_chunks")
    with pytest.raises(StoreBusyError, match="stop it first"):
        site.restore(backup)
    assert table(site.path, "raw_chunks") == before


def test_a_backup_of_a_newer_program_is_refused_by_name(site: Site) -> None:
    site.store.rows("SELECT 1")
    backup = site.back_up()
    with contextlib.closing(sqlite3.connect(backup / "rigcal.sqlite")) as db, db:
        db.execute("UPDATE _sqlite_migrations SET name = 'm999_tomorrow' WHERE name LIKE 'm015%'")
    site.store.close()
    with pytest.raises(StoreError, match="made by a newer rigcal"):
        site.restore(backup)
    assert captures(site.path) == 20


@pytest.mark.parametrize("damage", ["page", "chunk", "model", "models", "unfinished", "form"])
def test_a_damaged_backup_takes_no_good_stores_place(site: Site, damage: str) -> None:
    backup = site.back_up()
    if damage == "page":
        with (backup / "rigcal.sqlite").open("r+b") as file:
            file.seek(3 * 4096)
            file.write(b"\xa5" * 4096)
    elif damage == "chunk":
        with contextlib.closing(sqlite3.connect(backup / "rigcal.sqlite")) as db, db:
            db.execute("UPDATE raw_chunks SET chunk = zeroblob(200) WHERE id = 7")
    elif damage == "model":
        (backup / "models" / MODEL / MANIFEST).write_text('{"a": 2}')
    elif damage == "models":
        site.store.update("models", {"id": 1}, {"state": "retired"})
        shutil.rmtree(backup)
        backup = site.back_up()
        shutil.rmtree(backup / "models")
    elif damage == "unfinished":
        (backup / "backup.json").unlink()
    else:
        about = json.loads((backup / "backup.json").read_text())
        (backup / "backup.json").write_text(json.dumps(about | {"form": 2}))
    site.store.close()
    with pytest.raises(StoreError, match=r"damaged|not a backup|incomplete|format 2"):
        site.restore(backup)
    assert captures(site.path) == 20
    assert not [path for path in site.path.parent.iterdir() if not path.name.startswith(("models", "rigcal.sqlite"))]


def test_the_oldest_backups_go_once_a_new_one_is_sound(site: Site) -> None:
    made = [site.back_up(day, keep=2) for day in range(3)]
    assert [backup.path for backup in backups(site.backups)] == made[1:]
    site.store.update("raw_chunks", {"id": 3}, {"chunk": b"RCAP and nonsense"})
    with pytest.raises(StoreError, match="raw chunk 3"):
        site.back_up(3, keep=2)
    assert [backup.path for backup in backups(site.backups)] == made[1:]
    assert not list(site.backups.glob(".*"))
    site.store.update("raw_chunks", {"id": 3}, {"chunk": table(made[2] / "rigcal.sqlite", "raw_chunks")[2]["chunk"]})
    earlier = site.back_up(-100, keep=2)  # the clock was set back: it stays all the same
    assert [backup.path for backup in backups(site.backups)] == [earlier, made[2]]


def test_backups_of_the_store_that_was_here_before_stay_though_a_new_one_has_its_own(site: Site) -> None:
    before = [site.back_up(day) for day in range(3)]
    site.store.close()
    for path in site.path.parent.glob("rigcal.sqlite*"):
        path.unlink()
    site.store = Store(site.path)
    site.store.insert("boots", {"kernel_boot_id": BOOT, "booted_utc_ns": UTC_0 + 1})
    shutil.rmtree(site.models)
    made = [site.back_up(day, keep=2) for day in range(3, 7)]
    assert [backup.path for backup in backups(site.backups)] == [*before, *made[-2:]]


def test_two_backups_at_once_do_not_take_each_others_files_away(site: Site) -> None:
    tried: list[str] = []

    def second() -> None:
        if not tried:
            with pytest.raises(StoreError) as caught:
                site.back_up(1)
            tried.append(str(caught.value))

    first = make_backup(site.path, site.models, site.backups, 3, UTC_0, second)
    assert tried == [f"{site.backups}: another backup is being made there; wait for its end"]
    assert [backup.path for backup in backups(site.backups)] == [first.path]


def test_a_backup_that_is_given_up_or_killed_leaves_nothing_that_counts(site: Site) -> None:
    left = site.backups / ".rigcal-20200101T000000Z.unfinished"
    left.mkdir(parents=True)

    def give_up() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_backup(site.path, site.models, site.backups, 3, UTC_0, give_up)
    assert list(site.backups.iterdir()) == []


def test_a_disk_without_room_for_a_backup_is_told_before_it_is_filled(site: Site, tmp_path: Path) -> None:
    with (
        small_disk(tmp_path / "small", 1024) as place,
        pytest.raises(StoreError, match=r"MiB are free.*name a directory on a different disk"),
    ):
        make_backup(site.path, site.models, place / "backups", 3, UTC_0, nothing)


def test_the_daemon_makes_one_a_day_and_tells_when_it_cannot(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daily_backups, "BACKUP_RETRY_S", 0.0)
    clock = ManualClock(at(0.0))
    daily = DailyBackups(site.path, site.models, site.backups, 3, clock)
    daily.step()
    assert not site.backups.exists(), "it comes after some minutes"
    monkeypatch.setattr(daily_backups, "BACKUP_AFTER_S", 0.0)
    daily = DailyBackups(site.path, site.models, site.backups, 3, clock)
    for _ in range(3):
        daily.step()
    assert len(backups(site.backups)) == 1
    clock.advance(90_000.0)
    (site.models / MODEL / MANIFEST).unlink()
    daily.step()
    assert "manifest.json cannot be read" in daily.error()
    assert len(backups(site.backups)) == 1
    again = DailyBackups(site.path, site.models, site.backups, 3, clock)
    again.step()
    assert again.newest_utc_ns == at(0.0).utc_ns // NS_PER_S * NS_PER_S


def test_a_disk_of_backups_that_does_not_answer_holds_up_nothing_else_and_is_told(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daily_backups, "LOOK_S", 0.01)
    monkeypatch.setattr(daily_backups, "STOP_S", 0.01)
    monkeypatch.setattr(daily_backups, "LONGEST_S", 0.1)
    silent = site.backups / "rigcal-20260101T000000Z" / "backup.json"
    silent.parent.mkdir(parents=True)
    os.mkfifo(silent)  # its reader waits, as that of a network's disk does whose server is gone
    housekeeping = Housekeeping(site.store, ManualClock(at(0.0)), Keeping(None, 0, site.models, site.backups, 3))
    housekeeping.start()
    try:
        wait_until(lambda: "does not respond" in housekeeping.state.backup_error)
        site.store.mark_decoded(site.store.append_captures([frame(20, seconds=100.0)]))
        assert housekeeping.step(), "captures are packed"
    finally:
        housekeeping.stop()
        silent.write_text("{}")  # the reader's end


def test_a_check_names_what_is_damaged(site: Site) -> None:
    assert check_store(site.path, site.models).captures == 20
    site.store.update("raw_chunks", {"id": 5}, {"chunk": b"RCAP and nonsense"})
    (finding,) = check_store(site.path, site.models).findings
    assert finding.startswith("raw chunk 5: ")
