"""DBC and EDS files named by a rig: read once, and their decoding of its channels added to the recorded rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from calibration.rig.channels import Cia404Analogue, Cia406Encoder, Cia406Linear, DbcSignal
from calibration.rig.description import Rig
from daemon.rig_files import RigSource
from drivers.can.dbc import DbcFile
from drivers.can.raw_signal import SignalChannel
from drivers.canopen.pdo import TransmitPdo

# Default mapping of the devices' TPDO1 (for other mappings the rig file names an EDS): index, sub-index, bits.
_USUAL_MAPPING = {0x6004: 0x60040020, 0x6020: 0x60200120, 0x6130: 0x61300120, 0x7130: 0x71300110, 0x9130: 0x91300120}

CanopenChannel = Cia406Encoder | Cia406Linear | Cia404Analogue


@dataclass(frozen=True)
class ChannelFiles:
    """The content of a rig's DBC and EDS files that concerns its channels.

    Attributes:
        signals: channel -> signal of its DBC file.
        pdos: channel -> TPDO of its CANopen device: from its EDS file, or else the default one.
        decoding: channel that names a file -> how the file decodes its value, see `Rig.decoding`.
    """

    signals: Mapping[str, SignalChannel]
    pdos: Mapping[str, TransmitPdo]
    decoding: Mapping[str, str]

    @classmethod
    def read(cls, rig: Rig, directory: Path) -> ChannelFiles:
        """Read the files.

        Args:
            rig: the rig.
            directory: directory of its DBC and EDS files.

        Raises:
            DescriptionError: a DBC or EDS file is missing, malformed, or lacks a message, signal or object that a
                channel names.
        """
        opened: dict[str, DbcFile] = {}
        signals: dict[str, SignalChannel] = {}
        pdos: dict[str, TransmitPdo] = {}
        decoding: dict[str, str] = {}
        for channel in rig.channels:
            if isinstance(channel, DbcSignal):
                if channel.dbc not in opened:
                    opened[channel.dbc] = DbcFile(directory / channel.dbc)
                signals[channel.name] = _signal(channel, opened[channel.dbc])
                decoding[channel.name] = opened[channel.dbc].decoding(channel.message, channel.signal)
            elif isinstance(channel, CanopenChannel):
                pdos[channel.name] = pdo = _pdo(channel, directory)
                if channel.eds is not None:
                    decoding[channel.name] = pdo.decoding(_value_object(channel))
        return cls(signals, pdos, decoding)


def with_files(source: RigSource) -> tuple[RigSource, ChannelFiles]:
    """Read the DBC and EDS files of a rig; return the rig with their decoding of its channels, and the files.

    Raises:
        DescriptionError: as `ChannelFiles.read`.
    """
    files = ChannelFiles.read(source.rig, source.directory)
    rig = source.rig.with_decoding(files.decoding)
    return (source if rig is source.rig else replace(source, rig=rig, text=rig.text)), files


def _signal(channel: DbcSignal, file: DbcFile) -> SignalChannel:
    return file.channel(
        channel.name,
        channel.unit,
        channel.message,
        channel.signal,
        scale=channel.scale,
        offset=channel.offset,
        timeout_s=channel.timeout_s,
    )


def _pdo(channel: CanopenChannel, directory: Path) -> TransmitPdo:
    if channel.eds is not None:
        return TransmitPdo.from_eds(directory / channel.eds, channel.node, channel.pdo)
    return TransmitPdo.usual(channel.node, channel.pdo, [_USUAL_MAPPING[_value_object(channel)]])


def _value_object(channel: CanopenChannel) -> int:
    """Return the index of the object that holds the value."""
    return 0x6004 if isinstance(channel, Cia406Encoder) else int(channel.object, 16)
