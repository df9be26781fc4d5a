"""Mapping between CAN links and channel numbers in Vector logs (`.asc`, `.blf`), which contain no channel names."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from daemon.config.config import Config
from drivers.errors import DescriptionError
from drivers.logs.can_log import channel_name, read_can_log

SUFFIXES = (".asc", ".blf")

_NUMBERED = re.compile(r"can(\d{1,2})")


def channel_numbers(config: Config, stored: Iterable[str] = ()) -> dict[str, int]:
    """Return the channel number, from 1, of each CAN link in Vector logs.

    A link whose name, or else whose channel, is `can0` gets number 1, `can1` number 2, and so on. Other links get the
    remaining numbers in the order of the configuration.

    Args:
        config: the configuration, which names the links.
        stored: further CAN links, which are no longer configured.
    """
    names = [*dict.fromkeys([section.name for section in config.can] + list(stored))]
    called = [(name, name) for name in names] + [(section.channel, section.name) for section in config.can]
    numbers: dict[str, int] = {}
    for word, name in called:
        found = _NUMBERED.fullmatch(word)
        if found and name not in numbers and int(found[1]) + 1 not in numbers.values():
            numbers[name] = int(found[1]) + 1
    taken = set(numbers.values())
    free = (number for number in itertools.count(1) if number not in taken)
    return numbers | {name: next(free) for name in names if name not in numbers}


def links_of_channels(path: Path, config: Config, told: Mapping[str, int]) -> dict[str, str]:
    """Return channel name, as given by `read_can_log` -> link, for a Vector log.

    Args:
        path: the log.
        config: the configuration, which names the links.
        told: link -> channel number, from the session file of the log; empty where that does not contain it.

    Raises:
        DescriptionError: the log is malformed; or it has frames of one channel only, several links are configured, and
            the file's name is not that of the channel's link.
    """
    numbers = {name: number for name, number in told.items() if name in {section.name for section in config.can}}
    if told:
        return {channel_name(number): name for name, number in numbers.items()}
    known = {channel_name(number): name for name, number in channel_numbers(config).items()}
    only = _only_channel(path) if len(known) > 1 else None
    if only is not None:
        ending = links_named_by(path, known.values())
        if only == channel_name(1):
            return {only: _named_first(path, ending, list(known.values()))}
        if only in known and ending and known[only] not in ending:
            raise DescriptionError(
                str(path),
                f"has frames of link {known[only]!r} according to the channel number in this configuration, but of "
                f"{ending[0]!r} according to the file's name: links may have had other numbers where the file was "
                "made; give the session file of the export with --session, or rename the file if it is of "
                f"{known[only]!r}",
            )
    return known


def links_named_by(path: Path, names: Iterable[str]) -> list[str]:
    """Return the links after which an exported log may be named, longest name first."""
    ending = [name for name in names if path.stem == name or path.stem.endswith(f"-{name}")]
    return sorted(ending, key=len, reverse=True)


def _only_channel(path: Path) -> str | None:
    """Return the channel of all frames of a log; None if there are several channels, or no frames."""
    first = None
    for capture in read_can_log(path):
        if first is None:
            first = capture.link
        elif capture.link != first:
            return None
    return first


def _named_first(path: Path, ending: Sequence[str], names: Sequence[str]) -> str:
    """Return the link after which a log of channel 1 is named; earlier versions exported every link as channel 1."""
    if not ending:
        raise DescriptionError(
            str(path),
            "has frames of channel 1 only, which earlier versions used for every exported link, and its name does not "
            f"end with a link: name the file ...-LINK{path.suffix}, with LINK one of {', '.join(names)}; or give the "
            "session file of an export with --session",
        )
    return ending[0]
