"""What the acquisition benchmark measures with: a saturated bus between processes, and a station on a serial port.

Every frame carries its number, so that each one that is missing is known. Eight frames go out every millisecond, on a
fixed monotonic grid; one of them is a position of one of ten encoders, the others are of other machines on the bus.
"""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty
from collections.abc import Iterator
from typing import Literal, Protocol

import can

from simulators.devices.can.bus import Frame
from simulators.devices.can.slcan_adapter import SlcanAdapter

Transport = Literal["udp_multicast", "slcan"]

MULTICAST_GROUP = "239.74.163.2"
FRAMES_PER_MS = 8  # 8-byte frames of a saturated bus of 1 Mbit/s
ENCODER_NODES = tuple(range(1, 11))
OTHER_IDS = tuple(range(0x200, 0x23C))
STATION_HZ = 20

_PAYLOAD = struct.Struct("<II")  # position in counts (object 6004h), number of the frame


def frame_at(number: int) -> Frame:
    """The frame that goes out as the `number`-th."""
    turn, place = divmod(number, FRAMES_PER_MS)
    if place == 0:
        node = ENCODER_NODES[turn % len(ENCODER_NODES)]
        position = 10_000 + abs(turn // 10 % 4_000 - 2_000)  # to and fro, 0.5 deg/s
        return Frame(0x180 + node, _PAYLOAD.pack(position, number))
    return Frame(OTHER_IDS[(number - turn) % len(OTHER_IDS)], _PAYLOAD.pack(0, number))


def number_of(data: bytes) -> int:
    """The number that a frame carries."""
    return int(_PAYLOAD.unpack(data)[1])


def multicast_works(port: int) -> bool:
    """Whether processes of this host can reach each other over udp_multicast."""
    try:
        with multicast_bus(port) as sender, multicast_bus(port) as receiver:
            sender.send(can.Message(arbitration_id=1, is_extended_id=False))
            return receiver.recv(1.0) is not None
    except (can.CanError, OSError):
        return False


def multicast_bus(port: int) -> can.BusABC:
    """A bus between the processes of this host."""
    return can.Bus(MULTICAST_GROUP, "udp_multicast", port=port, hop_limit=0, ignore_config=True)


class Bus(Protocol):
    """Where frames go out."""

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus."""

    def close(self) -> None:
        """Let go of it."""


class MulticastSender:
    """Frames go to all listeners of a multicast port; a listener that is too slow loses them."""

    def __init__(self, port: int) -> None:
        self._bus = multicast_bus(port)

    def send(self, frame: Frame) -> None:
        self._bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False))

    def close(self) -> None:
        self._bus.shutdown()


class SlcanSender:
    """Frames go to serial ports as an slcan adapter sends them, one port a listener; a slow listener stops the bus.

    Attributes:
        paths: the ports.
    """

    def __init__(self, listeners: int) -> None:
        self._ptys = [os.openpty() for _ in range(listeners)]
        for ends in self._ptys:
            for end in ends:
                tty.setraw(end)
        self._adapters = [SlcanAdapter() for _ in self._ptys]
        self.paths = [os.ttyname(slave) for _, slave in self._ptys]

    def answer(self) -> None:
        """Obey what the listeners tell their adapters."""
        for (master, _), adapter in zip(self._ptys, self._adapters, strict=True):
            while select.select([master], [], [], 0)[0]:
                answers, _frames = adapter.feed(os.read(master, 4096))
                os.write(master, answers)

    def send(self, frame: Frame) -> None:
        for (master, _), adapter in zip(self._ptys, self._adapters, strict=True):
            os.write(master, adapter.encode(frame))

    def close(self) -> None:
        for ends in self._ptys:
            for end in ends:
                os.close(end)


def send_all(bus: Bus, seconds: float) -> float:
    """Send the frames of `seconds`; how long it took is more where this process was too slow."""
    started = time.monotonic()
    number = 0
    for millisecond in range(round(1000 * seconds)):
        ahead_s = started + millisecond / 1000 - time.monotonic()
        if ahead_s > 0:
            time.sleep(ahead_s)
        for _ in range(FRAMES_PER_MS):
            bus.send(frame_at(number))
            number += 1
    return time.monotonic() - started


class Station:
    """A station of the GTS-8 family on a pseudo-terminal that speaks 20 times a second.

    Attributes:
        path: its serial port.
        sent: how many records it has sent.
    """

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.sent = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="station", daemon=True)

    def start(self) -> None:
        """Begin to speak."""
        self._thread.start()

    def stop(self) -> None:
        """Fall silent and let go of the port."""
        self._stop.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        started = time.monotonic()
        for record in self._records():
            if self._stop.wait(max(0.0, started + self.sent / STATION_HZ - time.monotonic())):
                return
            os.write(self._master, record)
            self.sent += 1

    def _records(self) -> Iterator[bytes]:
        """Records of a prism that creeps away by 0.1 mm a record."""
        number = 0
        while True:
            distance = f"+{11_784_812 + number:09d}"
            text = f"Q{distance}m08520300+12030400d{distance}t15+0000+025001r".encode("ascii")
            check = 0
            for byte in text:
                check ^= byte
            yield text + f"{check:03d}".encode("ascii") + b"\x03\r\n"
            number += 1
