"""Base of the ports to a CAN bus, through which links receive and send frames."""

from __future__ import annotations

import abc
import contextlib
import errno
import os
from typing import NamedTuple

import can

from drivers.can.frame import Frame
from drivers.errors import LinkError

BATCH_MAX = 512  # frames per read, so that a flooded bus cannot keep the loop from its other duties

OVERFLOW = "the kernel's receive buffer was full"
NOT_A_FRAME = "not a classic CAN frame"
ADAPTER_LINE = "the adapter sent a line that is not a frame"
INTERFACE_DROPS = "the interface's statistics show losses"


class Received(NamedTuple):
    """A frame and the kernel's receive time (nanoseconds UTC), or None if the kernel gives none."""

    frame: Frame
    kernel_utc_ns: int | None


class Batch(NamedTuple):
    """Frames of one read.

    Attributes:
        received: the frames, in order.
        is_last: nothing was left to read.
    """

    received: list[Received]
    is_last: bool


class CanPort(abc.ABC):
    """An open port to a bus; python-can sends and closes. Every failure of the bus or its adapter raises LinkError."""

    def __init__(self, where: str, bus: can.BusABC) -> None:
        self._where = where
        self._bus = bus
        self._losses: dict[str, int] = {}

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> Batch:
        """Return up to BATCH_MAX frames; wait for at most `timeout_s` real seconds for the first."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame arrives; LinkError if there is none (`virtual`)."""
        raise LinkError(self._where, "an in-process bus has no descriptor")

    def send(self, frame: Frame) -> bool:
        """Send one frame without waiting; return False if the queue is full or the adapter refuses it."""
        message = can.Message(
            arbitration_id=frame.arbitration_id,
            data=frame.data,
            is_extended_id=frame.is_extended,
            is_remote_frame=frame.is_remote,
        )
        try:
            self._send(message)
        except (can.CanError, OSError) as error:
            if _is_queue_full(error):
                return False
            raise self._gone(error) from error
        return True

    def losses(self) -> dict[str, int]:
        """Return the number of frames lost since the port was opened, by reason."""
        return dict(self._losses)

    def close(self) -> None:
        """Close the port. Never raises."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _send(self, message: can.Message) -> None:
        self._bus.send(message, timeout=0.0)

    def _count_lost(self, reason: str, count: int = 1) -> None:
        self._losses[reason] = self._losses.get(reason, 0) + count

    def _gone(self, error: BaseException) -> LinkError:
        return LinkError(self._where, f"connection to the bus lost: {message_of(error)}")


def _is_queue_full(error: BaseException) -> bool:
    """Return True if a frame was not sent only because the transmit queue is full."""
    code = getattr(error.__cause__ or error, "errno", None)
    return code in (errno.ENOBUFS, errno.EAGAIN) or str(error) == "Transmit buffer full"  # python-can's, without a code


def message_of(error: BaseException) -> str:
    """Return the system's error text if there is one, without the repeated paths that libraries add to it."""
    cause = error.__cause__ or error
    if isinstance(cause, OSError) and cause.errno is not None and cause.errno > 0:
        return os.strerror(cause.errno)
    return str(error).strip().rstrip(".") or type(error).__name__


def frame_of(message: can.Message) -> Frame:
    """Return python-can's message as a frame."""
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        message.is_extended_id and not message.is_error_frame,
        message.is_remote_frame,
        message.is_error_frame,
    )
