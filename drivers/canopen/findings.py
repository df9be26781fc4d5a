"""Findings of a node's set-up, and the check that all answers came from one device."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.canopen.sdo import MISSING, AbortResponse, Upload, UploadResponse, decode_response
from drivers.errors import DeviceError


class MismatchError(DeviceError):
    """The node is not the expected one."""


@dataclass
class Findings:
    """Findings of a node's set-up so far.

    Attributes:
        serial_number: object 1018h.4; None if it was not read, does not exist or is 0.
        warnings: values that could not be verified.
        identity: the objects that identify the device, by index and sub-index; None for one that does not exist.
    """

    serial_number: int | None = None
    warnings: list[str] = field(default_factory=list)
    identity: dict[tuple[int, int], int | None] = field(default_factory=dict)

    def check_identity(self, where: str, data: bytes) -> None:
        """Compare an SDO message of the node with what has identified the device.

        Raises:
            MismatchError: it is a different answer to the same request, from a second device with the node's number.
        """
        try:
            answer = decode_response(data)
        except ValueError:
            return
        value: int | None
        if isinstance(answer, UploadResponse) and answer.data is not None:
            value = int.from_bytes(answer.data, "little")
        elif isinstance(answer, AbortResponse) and answer.code in MISSING:
            value = None
        else:
            return
        key = answer.index, answer.subindex
        if self.identity.get(key, value) == value:
            return
        before, after = ("no such object" if found is None else f"{found:X}h" for found in (self.identity[key], value))
        text = f"{Upload(*key)}: different answers, {before} and {after}; two devices have this node number, change one"
        raise MismatchError(where, text)
