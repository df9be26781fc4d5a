"""Targets with every fault that the runner has to notice."""

from __future__ import annotations

import os
import signal

from tests.fuzz.target import Run, Target


def _raising() -> Run:
    def run(data: bytes) -> None:
        data[len(data)]

    return run


def _hanging() -> Run:
    def run(data: bytes) -> None:
        while True:
            len(data)

    return run


def _dying() -> Run:
    return lambda data: os.kill(os.getpid(), signal.SIGSEGV)


def _hungry() -> Run:
    def run(data: bytes) -> None:
        bytearray(600 << 20)

    return run


def _sound() -> Run:
    return lambda data: None


TARGETS = [
    Target("raising", _raising),
    Target("hanging", _hanging),
    Target("dying", _dying),
    Target("hungry", _hungry),
    Target("sound", _sound),
]
