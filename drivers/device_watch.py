"""Waiting for a device to come back: notified by the kernel where possible, with a maximum wait otherwise.

The file of a serial device and udev's symbolic links to it appear in their directories (inotify(7)); a network
interface comes up (rtnetlink(7)). Both are watched here with the C library and a socket, so that no further dependency
is needed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Iterator

STOP_POLL_S = 0.05  # longest delay until a stop is noticed
SETTLE_S = 0.2  # from the first sign of a device to the attempt to open it: udev sets its owner and creates its links
_LINKS_MAX = 16  # longest chain of symbolic links that is followed

# Linux, include/uapi/linux/inotify.h
_IN_ATTRIB, _IN_MOVED_TO, _IN_CREATE, _IN_DELETE_SELF, _IN_MOVE_SELF = 0x004, 0x080, 0x100, 0x400, 0x800
_IN_OVERFLOW, _IN_IGNORED = 0x4000, 0x8000
_IN_ONLYDIR = 0x0100_0000
_APPEARING = _IN_ATTRIB | _IN_MOVED_TO | _IN_CREATE
_INOTIFY_EVENT = struct.Struct("@iIII")  # watch, mask, cookie, length of the name that follows

# Linux, include/uapi/linux/netlink.h, rtnetlink.h, if_link.h, if.h
_RTMGRP_LINK = 1
_RTM_NEWLINK = 16
_IFLA_IFNAME = 3
_IFF_UP = 1
_NETLINK_HEADER = struct.Struct("@IHHII")  # length, type, flags, sequence, sender
_LINK_MESSAGE = struct.Struct("@BxHiII")  # family, type, index, flags, changes
_ATTRIBUTE = struct.Struct("@HH")  # length, type

_libc = ctypes.CDLL(None, use_errno=True)


class DeviceWatch:
    """Waits for a device that may come back; see `watch_path` and `watch_interface`.

    The watch is active from the first `wait` until `close`, so that nothing is missed between two attempts to open the
    device. The first wait is short, because the device may have come back before it. Use a watch from one thread only.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None

    def wait(self, stop: threading.Event, timeout_s: float) -> bool:
        """Wait until the device may be back, for at most `timeout_s`, as the kernel does not report everything.

        Args:
            stop: event that ends the wait.
            timeout_s: real seconds, regardless of the link's clock, because people plug in devices.

        Returns:
            True if something happened to the device; False after the timeout or if `stop` was set.
        """
        if self._descriptor is None:
            with contextlib.suppress(OSError):  # no descriptors left, or no kernel support: only the timeout remains
                self._descriptor = self._open()
                timeout_s = min(timeout_s, SETTLE_S)  # it may have come back before the watch began
        self._renew()
        deadline = time.monotonic() + timeout_s
        while not stop.is_set() and (left_s := deadline - time.monotonic()) > 0:
            if self._descriptor is None:
                stop.wait(left_s)
            elif self._is_readable(min(left_s, STOP_POLL_S)) and self._has_news():
                stop.wait(min(SETTLE_S, max(deadline - time.monotonic(), 0.0)))
                self._has_news()
                return not stop.is_set()
        return False

    def close(self) -> None:
        """Stop watching until the next `wait`. Never raises."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = None

    def _is_readable(self, timeout_s: float) -> bool:
        assert self._descriptor is not None
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000))

    def _has_news(self) -> bool:
        """Read all messages from the kernel; return True if any concerns the device."""
        assert self._descriptor is not None
        news = False
        while True:
            try:
                message = os.read(self._descriptor, 1 << 16)
            except BlockingIOError:
                return news
            except OSError:  # the kernel's message buffer overflowed
                return True
            news = self._is_news(message) or news

    def _open(self) -> int:
        """Open a non-blocking descriptor that receives the kernel's messages."""
        raise OSError("nothing to watch")

    def _renew(self) -> None:
        """Update the watched places after a change."""

    def _is_news(self, message: bytes) -> bool:
        """Return True if a message from the kernel concerns the device."""
        raise NotImplementedError(message)


def watch_path(path: str) -> DeviceWatch:
    """Watch for a device's path to appear, including its symbolic links and missing directories."""
    return _PathWatch(path)


def watch_interface(name: str) -> DeviceWatch:
    """Watch for a network interface to come up."""
    return _InterfaceWatch(name)


def no_watch() -> DeviceWatch:
    """Watch nothing: for buses without a device, where only the timeout ends a wait."""
    return DeviceWatch()


class _PathWatch(DeviceWatch):
    """Watches the directories in which a path, or a part of it, would appear."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = os.path.abspath(path)
        self._names: dict[int, set[bytes]] = {}  # inotify watch -> names to look for in its directory

    def _open(self) -> int:
        self._names.clear()
        return _checked(_libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))

    def _renew(self) -> None:
        if self._descriptor is None:
            return
        mask = _APPEARING | _IN_DELETE_SELF | _IN_MOVE_SELF | _IN_ONLYDIR
        for directory, name in _places(self._path):
            with contextlib.suppress(OSError):  # it has just disappeared, or is not readable
                watch = _checked(_libc.inotify_add_watch(self._descriptor, os.fsencode(directory), mask))
                self._names.setdefault(watch, set()).add(os.fsencode(name))

    def _is_news(self, message: bytes) -> bool:
        at, news = 0, False
        while at < len(message):
            watch, mask, _cookie, length = _INOTIFY_EVENT.unpack_from(message, at)
            at += _INOTIFY_EVENT.size + length
            if mask & (_IN_OVERFLOW | _IN_IGNORED | _IN_DELETE_SELF | _IN_MOVE_SELF):
                news = True
            elif mask & _APPEARING:
                name = message[at - length : at].rstrip(b"\0")
                news = news or name in self._names.get(watch, ())
        return news


def _checked(result: int) -> int:
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return result


def _places(path: str) -> Iterator[tuple[str, str]]:
    """Yield (directory, name): the names that must appear for `path` to lead to a device."""
    for _ in range(_LINKS_MAX):
        directory, name = os.path.split(path)
        while not os.path.isdir(directory):
            directory, name = os.path.split(directory)
        yield directory, name
        try:
            path = os.path.join(os.path.dirname(path), os.readlink(path))
        except OSError:
            return


class _InterfaceWatch(DeviceWatch):
    """Listens to the kernel's messages about network interfaces."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._name = name.encode()

    def _open(self) -> int:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.NETLINK_ROUTE) as listener:
            listener.bind((0, _RTMGRP_LINK))
            return listener.detach()

    def _is_news(self, message: bytes) -> bool:
        at = 0
        while at + _NETLINK_HEADER.size <= len(message):
            length, kind, *_ = _NETLINK_HEADER.unpack_from(message, at)
            if length < _NETLINK_HEADER.size:
                return False
            if kind == _RTM_NEWLINK and self._is_up(message[at + _NETLINK_HEADER.size : at + length]):
                return True
            at += _aligned(length)
        return False

    def _is_up(self, link: bytes) -> bool:
        """Return True if a message reports that the interface is up."""
        if len(link) < _LINK_MESSAGE.size or not _LINK_MESSAGE.unpack_from(link)[3] & _IFF_UP:
            return False
        at = _LINK_MESSAGE.size
        while at + _ATTRIBUTE.size <= len(link):
            length, kind = _ATTRIBUTE.unpack_from(link, at)
            if kind == _IFLA_IFNAME:
                return link[at + _ATTRIBUTE.size : at + length].rstrip(b"\0") == self._name
            at += max(_aligned(length), _ATTRIBUTE.size)
        return False


def _aligned(length: int) -> int:
    return (length + 3) & ~3
