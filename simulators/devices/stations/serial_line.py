"""Timing of a serial line: bytes are sent one after the other, and a command is received with its last byte."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable

BITS_PER_BYTE = 10  # 8N1 and 7E1 alike
_GROUP = 16  # bytes passed on at a time; smaller groups would only wake the loop more often


class Line:
    """Queue of outgoing bytes and scheduled tasks, ordered by time.

    Args:
        baud: bits per second.
    """

    def __init__(self, baud: int) -> None:
        self.byte_s = BITS_PER_BYTE / baud
        self._out: deque[tuple[float, bytes, bool]] = deque()  # start, bytes, at once
        self._sent = 0  # bytes of the first chunk already sent
        self._free_s = -math.inf
        self._heard_s = -math.inf
        self._tasks: list[tuple[float, int, Callable[[float], None]]] = []
        self._number = 0

    def send(self, at_s: float, data: bytes, *, at_once: bool = False) -> float:
        """Queue bytes that start no earlier than `at_s`; return the time at which the last one is sent.

        Args:
            at_s: earliest start.
            data: the bytes.
            at_once: pass them on in one piece when the last one is sent, like a buffering radio modem.
        """
        start = max(at_s, self._free_s)
        self._free_s = start + len(data) * self.byte_s
        self._out.append((start, data, at_once))
        return self._free_s

    def heard_at(self, now_s: float, count: int) -> float:
        """Return the instant at which the last of `count` bytes that the host writes at `now_s` has arrived."""
        self._heard_s = max(now_s, self._heard_s) + count * self.byte_s
        return self._heard_s

    def later(self, at_s: float, task: Callable[[float], None]) -> None:
        """Schedule a task for an instant, which is passed to the task."""
        self._number += 1
        heapq.heappush(self._tasks, (at_s, self._number, task))

    def poll(self, now_s: float) -> bytes:
        """Run the tasks that are due; return the bytes that have been sent by now."""
        while self._tasks and self._tasks[0][0] <= now_s:
            at_s, _, task = heapq.heappop(self._tasks)
            task(at_s)
        out = b""
        while self._out:
            start, data, at_once = self._out[0]
            done = len(data) if now_s >= self._end(start, len(data)) else self._count(now_s, start)
            if at_once and done < len(data):
                break
            out += data[self._sent : done]
            self._sent = max(self._sent, done)
            if done < len(data):
                break
            self._out.popleft()
            self._sent = 0
        return out

    def next_deadline(self) -> float:
        """Return the instant at which `poll` is due."""
        due = self._tasks[0][0] if self._tasks else math.inf
        if self._out:
            start, data, at_once = self._out[0]
            count = len(data) if at_once else min(len(data), self._sent + _GROUP)
            due = min(due, self._end(start, count))
        return due

    def _end(self, start: float, count: int) -> float:
        return start + count * self.byte_s

    def _count(self, now_s: float, start: float) -> int:
        return max(0, int((now_s - start) / self.byte_s + 1e-6))
