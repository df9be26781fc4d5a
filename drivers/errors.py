"""Errors that drivers raise. Each names the link or device, the fault, and the remedy."""

from __future__ import annotations

MESSAGE_MAX = 1000
"""Longest error message in characters; a message may quote content of any length."""


class DriverError(Exception):
    """Base of all errors of `drivers`.

    Args:
        where: link, device or file (with line) that the error is about.
        message: the fault and the remedy; the text is cut off after MESSAGE_MAX characters.

    Attributes:
        where: link, device or file (with line) that the error is about.
    """

    def __init__(self, where: str, message: str) -> None:
        text = f"{where}: {message}"
        super().__init__(text if len(text) <= MESSAGE_MAX else f"{text[:MESSAGE_MAX]}...")
        self.where = where


class LinkError(DriverError):
    """A port could not be opened, or was lost while in use. A retry may succeed."""


class DeviceError(DriverError):
    """A device answered with an error, gave an invalid answer, or did not answer. The link itself works."""


class TransmitForbiddenError(DriverError):
    """A frame was to be sent on a link or to a node to which the configuration does not allow sending."""


class DescriptionError(DriverError):
    """An EDS, DBC, mapping table or captured file is malformed; the message states where and why."""
