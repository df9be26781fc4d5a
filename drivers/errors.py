"""Errors that drivers raise. Each names the link or device, the fault, and the remedy."""

from __future__ import annotations

MESSAGE_MAX = 1000
"""Characters of a message, which may quote whatever was found."""


class DriverError(Exception):
    """Base of all errors of `drivers`.

    Args:
        where: link, device or file (with line) that the error is about.
        message: the fault and the remedy; what is beyond MESSAGE_MAX is cut off.

    Attributes:
        where: as given.
    """

    def __init__(self, where: str, message: str) -> None:
        text = f"{where}: {message}"
        super().__init__(text if len(text) <= MESSAGE_MAX else f"{text[:MESSAGE_MAX]}...")
        self.where = where


class LinkError(DriverError):
    """A port could not be opened, or went away while in use. Worth trying again."""


class DeviceError(DriverError):
    """A device answered with an error, answered nonsense, or did not answer. The link itself works."""


class TransmitForbiddenError(DriverError):
    """Something asked to send on a link, or to a node, for which the configuration does not allow it."""


class DescriptionError(DriverError):
    """An EDS, DBC, mapping table or captured file is malformed; the message names place and reason."""
