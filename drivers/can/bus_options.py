"""Settings of a CAN link that python-can would take and fail of later: its channel, and further options.

Options are handed to python-can as they are: those that the link's own settings do not make. Two of one name would be
an argument given twice, or one that undoes the other: `listen_only` that of `allow_transmit`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

_LONGEST_NAME_TOLD = 100
_INTERFACE_NAME = re.compile(r"(?!\.{1,2}\Z)[^/:\s]{1,15}")  # Linux, net/core/dev.c, dev_valid_name
_SERIAL_PORT = re.compile(r"[^@]*[^@/](@[1-9][0-9]*)?")

_NO_OTHER_FILE = "no configuration of python-can is read beside this one"
# What `open_port` gives python-can's bus itself, under names that are no keys of a link.
_MADE: Mapping[str, str] = MappingProxyType(
    {
        "listen_only": "`allow_transmit` says it",
        "bustype": "`interface` says it",
        "ignore_config": _NO_OTHER_FILE,
        "config_context": _NO_OTHER_FILE,
        "context": _NO_OTHER_FILE,
    }
)


def check_channel(interface: str, channel: str) -> None:
    """Refuse a channel that names no network interface, or no serial port, where one is meant.

    Args:
        interface: kind of adapter, as python-can names it.
        channel: of the link.

    Raises:
        ValueError: a sentence on what to write instead.
    """
    if interface == "socketcan" and not _INTERFACE_NAME.fullmatch(channel):
        raise ValueError(
            f"{channel[:_LONGEST_NAME_TOLD]!r} is no name of a network interface, as can0 is one; an adapter at a "
            "serial port needs the interface slcan"
        )
    if interface == "slcan" and "/" not in channel:
        raise ValueError(
            f"{channel[:_LONGEST_NAME_TOLD]!r} is no serial port, as /dev/ttyACM0 is one; an interface of the network, "
            "as can0, needs the interface socketcan"
        )
    if interface == "slcan" and not _SERIAL_PORT.fullmatch(channel):
        raise ValueError(
            f"{channel[:_LONGEST_NAME_TOLD]!r} is no serial port: after the name of one comes nothing, or its rate, "
            "as in /dev/ttyUSB0@115200"
        )


def slcan_port(channel: str) -> str:
    """Return the path of the serial port in an slcan adapter's channel, which python-can takes as PORT@BAUD, too."""
    return channel.partition("@")[0]


def check_options(options: Mapping[str, object], keys: frozenset[str]) -> None:
    """Refuse options that repeat another setting, and values that no option has.

    Args:
        options: name -> value, as a configuration file has them.
        keys: of the link itself.

    Raises:
        ValueError: says which.
    """
    for name, value in options.items():
        if name in keys:
            raise ValueError(f"{name} has a key of its own: give it beside `options`, not in them")
        if name in _MADE:
            raise ValueError(f"{name} is no option: {_MADE[name]}; remove it")
        if not isinstance(value, str | int | float):
            raise ValueError(f"{name:.{_LONGEST_NAME_TOLD}} must be a text in quotes, a number, true or false")
