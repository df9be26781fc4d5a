"""Port to a serial adapter that speaks slcan (LAWICEL)."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
import time

import can
from can.interfaces.slcan import slcanBus

from drivers.can.frame import SlcanLines, slcan_line
from drivers.can.port import ADAPTER_LINE, Batch, CanPort, Received, frame_of
from drivers.errors import LinkError
from drivers.last_reads import more_may_wait

CLOSE_WRITE_S = 1.0  # longest wait for an slcan adapter to accept the command that closes its channel
OUTDATED_S = 0.05  # frames that the terminal of an slcan adapter has held for longer are discarded
REFUSALS = 3  # commands in a row that an adapter refuses until its channel counts as closed
SILENT_S = 5.0  # after so long without data the channel may be closed; real seconds


class SlcanPort(CanPort):
    """A serial adapter that speaks slcan (LAWICEL).

    An adapter may close its channel by itself, after a bus-off or a dip of its supply. It is then silent and refuses
    frames. The channel is therefore opened again after a silence and after refusals; an open channel refuses that.
    """

    def __init__(self, where: str, bus: slcanBus, *, is_listen_only: bool) -> None:
        super().__init__(where, bus)
        self._open_command = b"L\r" if is_listen_only else b"O\r"
        self._is_asked = False  # to open its channel, and the answer may be a refusal
        self._serial = bus.serialPortOrig
        self._serial.write_timeout = CLOSE_WRITE_S
        self._fd = bus.fileno()
        # Exclusive access: two readers on one port would each get half of the bytes
        fcntl.ioctl(self._fd, termios.TIOCEXCL)
        self._lines = SlcanLines()
        self._unwritten = b""  # end of a line that the terminal has accepted only in part
        self._emptied_s = self._heard_s = time.monotonic()  # when the adapter has taken all lines, and sent data

    def fileno(self) -> int:
        return self._fd

    def receive(self, timeout_s: float) -> Batch:
        try:
            if not select.select([self._fd], [], [], timeout_s)[0]:
                if time.monotonic() - self._heard_s > SILENT_S:
                    self._open_again()
                return Batch([], True)
            data = os.read(self._fd, 65536)
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise LinkError(self._where, "connection to the bus lost: the adapter was unplugged; plug it in again")
        self._heard_s = time.monotonic()
        frames = self._lines.feed(data)
        if self._is_asked and self._lines.refused:
            self._lines.refused, self._is_asked = self._lines.refused - 1, False
        if self._lines.malformed:
            self._count_lost(ADAPTER_LINE, self._lines.malformed)
            self._lines.malformed = 0
        return Batch([Received(frame, None) for frame in frames], not more_may_wait(data))

    def _send(self, message: can.Message) -> None:
        """Write the frame's line without waiting; python-can waits, however long, until the adapter has taken it.

        Lines that the adapter has not taken in time are discarded, as they would be outdated when it goes on.
        """
        if self._lines.refused >= REFUSALS:
            self._lines.refused = 0
            self._open_again()
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        if not self._serial.out_waiting:
            self._emptied_s = time.monotonic()
        elif time.monotonic() - self._emptied_s > OUTDATED_S:
            fcntl.ioctl(self._fd, termios.TCFLSH, termios.TCOFLUSH)
            self._unwritten = b"\r"  # ends a line of which the adapter has taken a part
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self._unwritten = self._unwritten[os.write(self._fd, self._unwritten) :]
        if self._unwritten:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        line = slcan_line(frame_of(message))
        self._unwritten = line[os.write(self._fd, line) :]

    def _open_again(self) -> None:
        """Open the adapter's channel, unless commands still wait for the adapter."""
        self._heard_s = time.monotonic()
        if not self._unwritten and not self._serial.out_waiting:
            os.write(self._fd, self._open_command)
            self._is_asked = True

    def close(self) -> None:
        super().close()
        with contextlib.suppress(OSError):
            self._serial.close()  # python-can leaves it open when the adapter is gone
