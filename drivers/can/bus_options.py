"""Checks of a CAN link's channel and further options, which python-can would accept and fail on later.

Options are passed to python-can unchanged. An option that repeats one of the link's own settings is refused: it would
pass the same argument twice, or undo a setting (`listen_only` would undo `allow_transmit`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

_LONGEST_NAME_TOLD = 100
_INTERFACE_NAME = re.compile(r"(?!\.{1,2}\Z)[^/:\s]{1,15}")  # Linux, net/core/dev.c, dev_valid_name
_SERIAL_PORT = re.compile(r"[^@]*[^@/](@[1-9][0-9]*)?")

_NO_OTHER_FILE = "rigcal does not read python-can's configuration files"
# Arguments that `open_port` itself passes to python-can's bus, and that are not keys of a link.
_MADE: Mapping[str, str] = MappingProxyType(
    {
        "listen_only": "`allow_transmit` sets it",
        "bustype": "`interface` sets it",
        "ignore_config": _NO_OTHER_FILE,
        "config_context": _NO_OTHER_FILE,
        "context": _NO_OTHER_FILE,
    }
)


def check_channel(interface: str, channel: str) -> None:
    """Refuse a channel that does not name the network interface or serial port that `interface` needs.

    Args:
        interface: kind of adapter, by python-can's name.
        channel: channel of the link.

    Raises:
        ValueError: the channel is wrong; the message states what to write instead.
    """
    if interface == "socketcan" and not _INTERFACE_NAME.fullmatch(channel):
        raise ValueError(
            f"{channel[:_LONGEST_NAME_TOLD]!r} is not the name of a network interface such as can0; for an adapter at "
            "a serial port use the interface slcan"
        )
    if interface == "slcan" and "/" not in channel:
        raise ValueError(
            f"{channel[:_LONGEST_NAME_TOLD]!r} is not a serial port such as /dev/ttyACM0; for a network interface such "
            "as can0 use the interface socketcan"
        )
    if interface == "slcan" and not _SERIAL_PORT.fullmatch(channel):
        raise ValueError(
            f"{channel[:_LONGEST_NAME_TOLD]!r} is not a valid serial port; write its path, optionally followed by @ "
            "and its baud rate, for example /dev/ttyUSB0@115200"
        )


def slcan_port(channel: str) -> str:
    """Return the path of the serial port in an slcan adapter's channel, which is PORT or PORT@BAUD in python-can."""
    return channel.partition("@")[0]


def check_options(options: Mapping[str, object], keys: frozenset[str]) -> None:
    """Refuse options that repeat another setting, and values of a type that no option has.

    Args:
        options: name -> value, from a configuration file.
        keys: names of the link's own keys.

    Raises:
        ValueError: an option is refused; the message names it.
    """
    for name, value in options.items():
        if name in keys:
            raise ValueError(f"{name} is a key of the link: set it in the link itself, not in `options`")
        if name in _MADE:
            raise ValueError(f"{name} cannot be given as an option: {_MADE[name]}; remove it")
        if not isinstance(value, str | int | float):
            raise ValueError(f"{name:.{_LONGEST_NAME_TOLD}} must be a string in quotes, a number, true or false")
