"""Who waits for a device is woken when it may be back: real directories, links, pseudo-terminals and interfaces."""

from __future__ import annotations

import ctypes
import fcntl
import os
import pty
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.device_watch import DeviceWatch, no_watch, watch_interface, watch_path

LONG_S = 60.0  # far beyond any wake-up: a wait that lasts so long was not woken
SHORT_S = 0.3


def wakes(watch: DeviceWatch, cause: Callable[[], object]) -> bool:
    """Return True if `cause` ends a long wait that had begun before."""
    assert not watch.wait(threading.Event(), SHORT_S)
    woken: list[bool] = []
    waiter = threading.Thread(target=lambda: woken.append(watch.wait(threading.Event(), LONG_S)))
    started = time.monotonic()
    waiter.start()
    cause()
    waiter.join()
    watch.close()
    return woken == [True] and time.monotonic() - started < LONG_S


def test_a_device_that_appears_ends_the_wait(tmp_path: Path) -> None:
    path = tmp_path / "ttyUSB0"
    assert wakes(watch_path(str(path)), path.touch)


def test_a_link_that_is_moved_into_place_ends_the_wait_as_udev_makes_them(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB0").touch()
    fresh = tmp_path / ".new"
    fresh.symlink_to("ttyUSB0")
    assert wakes(watch_path(str(tmp_path / "station")), lambda: fresh.rename(tmp_path / "station"))


def test_a_device_that_appears_behind_a_link_that_stayed_ends_the_wait(tmp_path: Path) -> None:
    devices = tmp_path / "devices"
    devices.mkdir()
    (tmp_path / "station").symlink_to("devices/ttyUSB0")
    assert wakes(watch_path(str(tmp_path / "station")), (devices / "ttyUSB0").touch)


def test_a_device_in_a_directory_that_went_with_it_ends_the_wait(tmp_path: Path) -> None:
    directory = tmp_path / "serial" / "by-id"
    watch = watch_path(str(directory / "adapter"))

    def appear() -> None:
        directory.mkdir(parents=True)
        (directory / "adapter").touch()

    assert wakes(watch, appear)


def test_a_directory_that_goes_and_comes_again_during_the_wait_is_watched_again(tmp_path: Path) -> None:
    directory = tmp_path / "by-id"
    directory.mkdir()
    watch = watch_path(str(directory / "adapter"))
    assert wakes(watch, directory.rmdir)
    directory.mkdir()
    assert wakes(watch, (directory / "adapter").touch)


def test_an_owner_that_is_set_late_ends_the_wait(tmp_path: Path) -> None:
    path = tmp_path / "ttyUSB0"
    path.touch()
    assert wakes(watch_path(str(path)), lambda: path.chmod(0o660))


def test_a_pseudo_terminal_that_is_made_ends_the_wait() -> None:
    # The lowest free number is given: with others free below it, no other process takes this one.
    made = [n for _ in range(24) for n in pty.openpty()]
    path = os.ttyname(made[-1])
    while made:
        os.close(made.pop())
    try:
        assert wakes(watch_path(path), lambda: made.extend(n for _ in range(32) for n in pty.openpty()))
    finally:
        for descriptor in made:
            os.close(descriptor)


def test_other_devices_do_not_end_the_wait(tmp_path: Path) -> None:
    watch = watch_path(str(tmp_path / "ttyUSB0"))
    assert not watch.wait(threading.Event(), 0.0)
    (tmp_path / "ttyUSB1").touch()
    assert not watch.wait(threading.Event(), SHORT_S)
    watch.close()


def test_what_happened_between_two_waits_is_not_missed(tmp_path: Path) -> None:
    watch = watch_path(str(tmp_path / "ttyUSB0"))
    assert not watch.wait(threading.Event(), 0.0)
    (tmp_path / "ttyUSB0").touch()
    assert watch.wait(threading.Event(), LONG_S)
    assert not watch.wait(threading.Event(), SHORT_S)
    watch.close()


@pytest.mark.parametrize("watch", [watch_path("/tmp/none/ttyUSB0"), watch_interface("can9"), no_watch()])
def test_a_stop_ends_the_wait(watch: DeviceWatch) -> None:
    stop, ended = threading.Event(), threading.Event()

    def wait() -> None:
        assert not watch.wait(stop, LONG_S)
        ended.set()

    waiter = threading.Thread(target=wait)
    waiter.start()
    stop.set()
    assert ended.wait(LONG_S / 2)
    waiter.join()
    watch.close()


def test_where_nothing_can_be_watched_the_time_ends_the_wait() -> None:
    assert not no_watch().wait(threading.Event(), 0.01)


CLONE_NEWNET = 0x4000_0000
SIOCGIFFLAGS, SIOCSIFFLAGS, IFF_UP = 0x8913, 0x8914, 1
IFREQ = struct.Struct("16sh14x")


def set_interface(name: bytes, *, up: bool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        flags = IFREQ.unpack(fcntl.ioctl(control, SIOCGIFFLAGS, IFREQ.pack(name, 0)))[1]
        flags = flags | IFF_UP if up else flags & ~IFF_UP
        fcntl.ioctl(control, SIOCSIFFLAGS, IFREQ.pack(name, flags))


@pytest.mark.parametrize("watched", ["lo", "can0"])
def test_an_interface_that_comes_up_ends_the_wait_of_its_own_link_alone(watched: str) -> None:
    """In a network of this thread's own, whose only interface is down at first."""
    results: list[object] = []

    def run() -> None:
        if ctypes.CDLL(None, use_errno=True).unshare(CLONE_NEWNET):
            results.append(os.strerror(ctypes.get_errno()))
            return
        watch = watch_interface(watched)
        stop = threading.Event()
        results.append(watch.wait(stop, SHORT_S))
        set_interface(b"lo", up=True)
        results.append(watch.wait(stop, LONG_S if watched == "lo" else SHORT_S))
        set_interface(b"lo", up=False)
        results.append(watch.wait(stop, SHORT_S))
        watch.close()

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if isinstance(results[0], str):
        pytest.skip(f"this user may make no network of their own: {results[0]}")
    assert results == [False, watched == "lo", False]
