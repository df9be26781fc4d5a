"""Decoders and device set-ups of the drivers for a rig's channels, as described by the rig file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypedDict, assert_never

from calibration.rig.channels import Channel, Cia404Analogue, Cia406Encoder, Cia406Linear, DbcSignal, RawSignal
from calibration.rig.description import Rig
from daemon.acquisition.channel_files import CanopenChannel, ChannelFiles
from drivers.can.channel import ChannelDecoder
from drivers.can.raw_signal import BitField, SignalChannel, SignalDecoder
from drivers.canopen.cia404 import AnalogueChannel, AnalogueDecoder
from drivers.canopen.cia406 import EncoderChannel, EncoderDecoder, LinearChannel, LinearDecoder
from drivers.canopen.node_setup import PROFILE_ANALOGUE, PROFILE_ENCODER, NodeSetup
from drivers.canopen.pdo import TransmitPdo
from drivers.errors import DescriptionError


def decoder_factories(rig: Rig, files: ChannelFiles, link: str) -> list[Callable[[], ChannelDecoder]]:
    """Return, for each channel of a link, a function that makes a fresh decoder.

    Args:
        rig: the rig.
        files: the rig's DBC and EDS files.
        link: name of the CAN link.

    Raises:
        DescriptionError: a channel lies beyond its frame, or is not in its PDO.
    """
    return [_factory(channel, rig, files) for channel in rig.channels if channel.link == link]


def node_setups(rig: Rig, files: ChannelFiles, link: str) -> list[NodeSetup]:
    """Return the settings that active set-up checks and writes in each CANopen node of a link.

    Args:
        rig: the rig.
        files: the rig's DBC and EDS files.
        link: name of the CAN link.
    """
    return [
        NodeSetup(
            node=channel.node,
            name=channel.name,
            profile=PROFILE_ANALOGUE if isinstance(channel, Cia404Analogue) else PROFILE_ENCODER,
            pdo=files.pdos[channel.name],
            pdo_number=channel.pdo,
            mode=channel.mode,
            period_ms=channel.period_ms,
            heartbeat_ms=channel.heartbeat_ms,
            units_per_revolution=channel.units_per_revolution if isinstance(channel, Cia406Encoder) else None,
            total_units=channel.total_units if isinstance(channel, Cia406Encoder) else None,
            step_nm=channel.step_nm if isinstance(channel, Cia406Linear) else None,
            decimal_digits=channel.decimal_digits if isinstance(channel, Cia404Analogue) else None,
        )
        for channel in rig.channels
        if isinstance(channel, CanopenChannel) and channel.link == link
    ]


def _factory(channel: Channel, rig: Rig, files: ChannelFiles) -> Callable[[], ChannelDecoder]:
    match channel:
        case Cia406Encoder():
            encoder = EncoderChannel(
                **_canopen(channel, files),
                sign=channel.sign,
                zero_counts=channel.zero_counts,
                max_rate_per_s=_max_rate(rig, channel.name),
                units_per_revolution=channel.units_per_revolution,
                total_units=channel.total_units,
            )
            return lambda: EncoderDecoder(encoder)
        case Cia406Linear():
            linear = LinearChannel(
                **_canopen(channel, files),
                sign=channel.sign,
                zero_counts=channel.zero_counts,
                max_rate_per_s=_max_rate(rig, channel.name),
                position_object=int(channel.object, 16),
                step_nm=channel.step_nm,
                range_mm=channel.range_mm,
            )
            return lambda: LinearDecoder(linear)
        case Cia404Analogue():
            analogue = AnalogueChannel(
                **_canopen(channel, files),
                process_value=int(channel.object, 16),
                decimal_digits=channel.decimal_digits,
                scale=channel.scale,
                offset=channel.offset,
                max_rate_per_s=_max_rate(rig, channel.name),
            )
            return lambda: AnalogueDecoder(analogue)
        case DbcSignal():
            signal = replace(files.signals[channel.name], max_rate_per_s=_max_rate(rig, channel.name))
            return lambda: SignalDecoder(signal)
        case RawSignal():
            raw = SignalChannel(
                name=channel.name,
                unit=channel.unit,
                arbitration_id=channel.arbitration_id,
                field=_bit_field(channel),
                is_extended=channel.is_extended,
                scale=channel.scale,
                offset=channel.offset,
                not_available=frozenset(channel.not_available),
                timeout_s=channel.timeout_s,
                max_rate_per_s=_max_rate(rig, channel.name),
            )
            return lambda: SignalDecoder(raw)
        case _:
            assert_never(channel)


class _CanopenPart(TypedDict):
    """Settings that the drivers' CANopen channels have in common."""

    name: str
    unit: str
    node: int
    pdo: TransmitPdo
    pdo_number: int
    is_synchronous: bool
    heartbeat_ms: int
    timeout_s: float


def _canopen(channel: CanopenChannel, files: ChannelFiles) -> _CanopenPart:
    return {
        "name": channel.name,
        "unit": channel.unit,
        "node": channel.node,
        "pdo": files.pdos[channel.name],
        "pdo_number": channel.pdo,
        "is_synchronous": channel.mode == "sync",
        "heartbeat_ms": channel.heartbeat_ms,
        "timeout_s": channel.timeout_s,
    }


def _bit_field(channel: RawSignal) -> BitField:
    try:
        return BitField(channel.start_bit, channel.length_bits, channel.byte_order, channel.is_signed)
    except ValueError as error:
        raise DescriptionError(f"channel {channel.name!r}", str(error)) from error


def _max_rate(rig: Rig, name: str) -> float | None:
    """Return the joint's greatest rate; None for a channel that is not a joint, whose jumps are not detected."""
    return rig.joint(name).max_rate if name in rig.joint_names else None
