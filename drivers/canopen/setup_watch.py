"""What the set-ups of a node have shown about it: whether it is the device in the rig file, and still the same one."""

from __future__ import annotations

import re

from drivers.canopen.findings import Findings, MismatchError
from drivers.canopen.node_setup import (
    ANSWER_TIMEOUT_NS,
    ATTEMPTS,
    DEVICE_TYPE,
    NOT_USED,
    NodeSetup,
    Script,
    next_transfer,
    setup_script,
)
from drivers.canopen.sdo import SdoExchange, encode_upload
from drivers.clock import Stamp
from drivers.errors import DeviceError
from drivers.readings import DeviceEvent, EventKind

_SERIAL_NUMBER = re.compile(r"serial number ([0-9A-F]+)h")


class SetupWatch:
    """Follows rigcal's set-ups of one node by the SDO messages on the bus, and draws the same conclusions as a set-up.

    A set-up begins with rigcal's own request for object 1000h. What another master reads from the node shows nothing.
    Everything follows from the messages on the bus, so a recording of them shows the same as the bus did.

    Args:
        setup: expected identity and settings of the node.

    Attributes:
        is_mismatched: a set-up has shown that the node is not the device in the rig file, and none has succeeded since.
            A set-up that fails for a different reason, such as no answer, does not change this.
    """

    def __init__(self, setup: NodeSetup) -> None:
        self.name = setup.name
        self.is_mismatched = False
        self._setup = setup
        self._serial_number: int | None = None  # that was read last; None if unknown
        self._found = Findings()
        self._script: Script
        self._exchange: SdoExchange | None = None  # None while no set-up is in progress
        self._requested: Stamp  # time of the last request

    def requested(self, stamp: Stamp, data: bytes) -> None:
        """Process an SDO request that rigcal has sent to the node."""
        self._requested = stamp
        if data == encode_upload(DEVICE_TYPE, 0):  # every set-up begins with it
            self._found = Findings()
            self._script = setup_script(self._setup, self._found)
            self._step(None)

    def feed(self, stamp: Stamp, data: bytes) -> str | None:
        """Process an SDO message from the node.

        Returns:
            If it shows a different device than the last set-up, the serial numbers of both in words.
        """
        exchange = self._exchange
        # A set-up does not wait longer: it has ended, and another master reads
        if exchange is None or stamp.since(self._requested) > ATTEMPTS * ANSWER_TIMEOUT_NS:
            return None
        try:
            self._found.check_identity(self._setup.where, data)
            exchange.feed(data)
        except DeviceError as error:
            return self._step(error)
        return None if exchange.result is None else self._step(exchange.result)

    def booted(self) -> None:
        """End a set-up in progress, because the node has booted, unless nothing was read from the node yet."""
        if self._exchange is not None and self._exchange.transfer.index != DEVICE_TYPE:
            self._exchange = None

    def recall(self, event: DeviceEvent) -> None:
        """Restore what a set-up has shown before this watch was created, from its CONFIGURED, ALARM or PRESET_JUMP."""
        if event.kind is EventKind.ALARM:
            self.is_mismatched |= event.text.endswith(NOT_USED)
            return
        found = _SERIAL_NUMBER.search(event.text)
        self._serial_number = int(found[1], 16) or None if found else None
        if event.kind is EventKind.CONFIGURED:
            self.is_mismatched = False

    def _step(self, outcome: bytes | DeviceError | None) -> str | None:
        """Go on with the set-up until its next transfer or its end, and return the result of `feed`."""
        self._exchange = None
        try:
            transfer = next_transfer(self._script, outcome, lambda _: None)
            self._exchange = SdoExchange(self._setup.where, transfer)
        except StopIteration:
            self.is_mismatched = False
            self._serial_number = self._found.serial_number
        except MismatchError:
            self.is_mismatched = True
        except DeviceError:
            pass  # the set-up has failed
        found, known = self._found.serial_number, self._serial_number
        if found is None or found == known:
            return None
        self._serial_number = found
        return None if known is None else f"serial number {found:X}h, before {known:X}h"
