"""Listens to a CAN bus and to serial ports without sending, for `rigcal init`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.can.ports import CanLinkConfig, open_port
from drivers.canopen.cia301 import Service, classify
from drivers.clock import NS_PER_S, Clock
from drivers.readings import Fix, SerialCapture
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.profiles import codecs_by_family
from drivers.stations.serial_port import SerialConfig, SerialPort

_WAIT_S = 0.1
_OF_NODES = (Service.HEARTBEAT, Service.TPDO, Service.EMCY, Service.SDO_RESPONSE)  # services that nodes send
BAUDS = (9600, 19200, 38400, 4800, 2400, 1200, 57600, 115200)  # the most common first
FORMATS = ((8, "none"), (7, "even"))


@dataclass(frozen=True)
class HeardBus:
    """Frames received from a CAN bus.

    Attributes:
        identifiers: 11-bit or 29-bit identifier -> number of frames.
        nodes: sorted CANopen nodes that sent a heartbeat, a process data object, an emergency or an SDO response.
    """

    identifiers: dict[int, int]
    nodes: tuple[int, ...]


@dataclass(frozen=True)
class HeardStation:
    """A serial port on which valid records of a total station were received.

    Attributes:
        serial: the port and its settings.
        family: protocol of the records, as in the configuration key `listen_to`.
        records: number of records.
    """

    serial: SerialConfig
    family: str
    records: int


def hear_bus(config: CanLinkConfig, seconds: float, clock: Clock) -> HeardBus:
    """Listen to a bus.

    Args:
        config: of the link; it must not allow transmission.
        seconds: how long to listen.
        clock: measures the time.

    Raises:
        LinkError: the bus cannot be opened, or was lost.
        ValueError: the configuration allows transmission.
    """
    if config.allow_transmit or config.sync_period_ms is not None:
        raise ValueError("the configuration of a bus to listen to must not allow transmission")
    counts: Counter[int] = Counter()
    nodes: set[int] = set()
    until_ns = clock.monotonic_ns() + round(seconds * NS_PER_S)
    port = open_port(config)
    try:
        while clock.monotonic_ns() < until_ns:
            for received in port.receive(_WAIT_S).received:
                if received.frame.is_error:
                    continue
                counts[received.frame.arbitration_id] += 1
                meaning = classify(received.frame.arbitration_id) if received.frame.is_plain else None
                if meaning is not None and meaning.node and meaning.service in _OF_NODES:
                    nodes.add(meaning.node)
    finally:
        port.close()
    return HeardBus(dict(sorted(counts.items())), tuple(sorted(nodes)))


def serial_ports() -> list[str]:
    """Return the plugged-in serial adapters, by persistent names where they exist."""
    named = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*"))
    rule = [str(path) for path in (Path("/dev/rigcal-station"),) if path.exists()]
    found = rule + named
    known = {str(Path(path).resolve()) for path in found}
    plugged = (path for pattern in ("ttyUSB*", "ttyACM*") for path in sorted(Path("/dev").glob(pattern)))
    return found + [str(path) for path in plugged if str(path) not in known]


def hear_station(path: str, seconds: float, clock: Clock, bauds: Sequence[int] = BAUDS) -> HeardStation | None:
    """Listen to a serial port with each baud and format until valid records are received.

    An instrument that sends only on request cannot be detected.

    Args:
        path: of the port.
        seconds: how long to listen with each baud and format.
        clock: stamps the received data.
        bauds: bauds to try, in this order.

    Returns:
        The first setting that gives valid records; None if there is none.

    Raises:
        LinkError: the port cannot be opened, or was lost.
    """
    for serial in _settings(path, bauds):
        chunks = _received(serial, seconds, clock)
        for family in codecs_by_family() if chunks else ():
            station = StationConfig(profile="passive", listen_to=family, serial=serial, silence_timeout_s=0)
            decoder = StationDecoder(station)
            records = sum(isinstance(record, Fix) for chunk in chunks for record in decoder.feed(chunk))
            if records:
                return HeardStation(serial, family, records)
    return None


def _settings(path: str, bauds: Sequence[int]) -> Iterator[SerialConfig]:
    for bytesize, parity in FORMATS:
        for baud in bauds:
            yield SerialConfig.model_validate({"path": path, "baud": baud, "bytesize": bytesize, "parity": parity})


def _received(serial: SerialConfig, seconds: float, clock: Clock) -> list[SerialCapture]:
    until_ns = clock.monotonic_ns() + round(seconds * NS_PER_S)
    port = SerialPort(serial, "station")
    chunks = []
    try:
        while clock.monotonic_ns() < until_ns:
            if data := port.read(_WAIT_S):
                chunks.append(SerialCapture("station", clock.now(), data))
    finally:
        port.close()
    return chunks
