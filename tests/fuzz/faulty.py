"""Targets with every fault that the runner has to notice."""

from __future__ import annotations

import os
import signal

from tests.fuzz.target import Run, Target


def _raising() -> Run:
    return lambda data: [][len(data)]  # type: ignore[return-value]


def _hanging() -> Run:
    def run(data: bytes) -> None:
        while True:
            len(data)

    return run


def _dying() -> Run:
    return lambda data: os.kill(os.getpid(), signal.SIGSEGV)


def _hungry() -> Run:
    return lambda data: [].append(bytearray(600 << 20))  # type: ignore[func-returns-value]


def _sound() -> Run:
    return lambda data: None


TARGETS = [
    Target("raising", _raising),
    Target("hanging", _hanging),
    Target("dying", _dying),
    Target("hungry", _hungry),
    Target("sound", _sound),
]
