"""What the set-ups of a node have shown about it: whether it is the device in the rig file, and still the same one."""

from __future__ import annotations

import re

from drivers.canopen.node_setup import (
    DEVICE_TYPE,
    NOT_USED,
    Findings,
    MismatchError,
    NodeSetup,
    Script,
    next_transfer,
    setup_script,
)
from drivers.canopen.sdo import AbortResponse, SdoExchange, UploadResponse, decode_response
from drivers.errors import DeviceError
from drivers.readings import DeviceEvent, EventKind

_SERIAL_NUMBER = re.compile(r"serial number ([0-9A-F]+)h")


class SetupWatch:
    """Follows the set-ups of one node by the node's SDO answers, from which it draws the same conclusions as a set-up.

    It needs no messages from the set-up itself, so a recording of the bus shows the same as the bus did.

    Args:
        setup: expected identity and settings of the node.

    Attributes:
        is_mismatched: a set-up has shown that the node is not the device in the rig file, and none has succeeded since.
            A set-up that fails for a different reason, such as no answer, shows nothing.
    """

    def __init__(self, setup: NodeSetup) -> None:
        self.name = setup.name
        self.is_mismatched = False
        self._setup = setup
        self._serial_number: int | None = None  # at the last set-up that showed no wrong device; None if unknown
        self._found = Findings()
        self._script: Script
        self._exchange: SdoExchange | None = None  # None while no set-up is in progress

    def feed(self, data: bytes) -> str | None:
        """Process an SDO message from the node.

        Returns:
            If it ends a set-up of a different device than the last one, the serial numbers of both in words.
        """
        if _is_device_type(data):  # every set-up begins with it
            self._found = Findings()
            self._script = setup_script(self._setup, self._found)
            self._step(None)
        exchange = self._exchange
        if exchange is None:
            return None
        try:
            exchange.feed(data)
        except DeviceError as error:
            return self._step(error)
        return None if exchange.result is None else self._step(exchange.result)

    def booted(self) -> None:
        """End a set-up in progress, because the node has booted."""
        self._exchange = None

    def recall(self, event: DeviceEvent) -> None:
        """Restore what a set-up has shown before this watch was created, from its CONFIGURED or ALARM event."""
        if event.kind is EventKind.CONFIGURED:
            self.is_mismatched = False
            found = _SERIAL_NUMBER.search(event.text)
            self._serial_number = int(found[1], 16) or None if found else None
        elif event.text.endswith(NOT_USED):
            self.is_mismatched = True

    def _step(self, outcome: bytes | DeviceError | None) -> str | None:
        """Go on with the set-up until its next transfer or its end, and return the result of `feed`."""
        self._exchange = None
        try:
            transfer = next_transfer(self._script, outcome, lambda _: None)
        except StopIteration:
            self.is_mismatched = False
            exchanged = self._exchanged()
            self._serial_number = self._found.serial_number
            return exchanged
        except MismatchError:
            self.is_mismatched = True  # no value is used, so a serial number that is not the last one loses nothing
            return None
        except DeviceError:
            return None if self.is_mismatched else self._exchanged()
        self._exchange = SdoExchange(self._setup.where, transfer)
        return None

    def _exchanged(self) -> str | None:
        found, known = self._found.serial_number, self._serial_number
        if found is None or known is None or found == known:
            return None
        self._serial_number = found
        return f"serial number {found:X}h, before {known:X}h"


def _is_device_type(data: bytes) -> bool:
    try:
        response = decode_response(data)
    except ValueError:
        return False
    return isinstance(response, UploadResponse | AbortResponse) and (response.index, response.subindex) == (
        DEVICE_TYPE,
        0,
    )
