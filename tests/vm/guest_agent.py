"""In the machine: does what the host asks for, one JSON object a line on a virtual port, any number at a time.

    {"id": 1, "run": "id -u", "timeout_s": 60}     -> {"id": 1, "status": 0, "output": "0\\n", ...}
    {"id": 2, "ask": "status", "arguments": {}}    -> {"id": 2, "answer": {...}, ...}
    {"id": 3, "write": "/etc/x", "text": "..."}    -> {"id": 3, ...}
    {"id": 4, "query": "SELECT ...", "store": ...} -> {"id": 4, "answer": [[...], ...], ...}
    {"id": 5, "tell": "now"}                       -> {"id": 5, ...}

Every answer has `began_s` and `ended_s`, instants of the machine's own monotonic clock. It runs with the system's
Python and its standard library only, and starts nothing where a command is for the daemon: processes are dear in
emulation.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Any

PORT = "/dev/virtio-ports/rigcal.agent"
SOCKET = "/run/rigcal/control.sock"


def run(message: dict[str, Any]) -> dict[str, Any]:
    """Run a shell command, and say what it said."""
    done = subprocess.run(
        ["bash", "-c", message["run"]],
        check=False,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=message.get("timeout_s", 120),
        start_new_session=True,
    )
    return {"status": done.returncode, "output": done.stdout.decode("utf-8", "replace")}


def ask(message: dict[str, Any]) -> dict[str, Any]:
    """Send the daemon a command by its socket."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(message.get("timeout_s", 120))
        connection.connect(message.get("socket", SOCKET))
        request = {"command": message["ask"], "arguments": message.get("arguments", {})}
        with connection.makefile("rwb") as stream:
            stream.write(json.dumps(request).encode() + b"\n")
            stream.flush()
            return {"answer": json.loads(stream.readline())}


def write(message: dict[str, Any]) -> dict[str, Any]:
    """Write a file."""
    os.makedirs(os.path.dirname(message["write"]), exist_ok=True)
    with open(message["write"], "w", encoding="utf-8") as file:
        file.write(message["text"])
    return {}


def query(message: dict[str, Any]) -> dict[str, Any]:
    """Read the store."""
    with contextlib.closing(sqlite3.connect(f"file:{message['store']}?mode=ro", uri=True)) as store:
        return {"answer": store.execute(message["query"]).fetchall()}


def tell(_: dict[str, Any]) -> dict[str, Any]:
    """Say what time it is, as every answer does."""
    return {}


def serve(message: dict[str, Any], say: Callable[[dict[str, Any]], None]) -> None:
    """Answer one message."""
    work = next(work for work in (run, ask, write, query, tell) if work.__name__ in message)
    began_s = time.monotonic()
    try:
        answer = work(message)
    except subprocess.TimeoutExpired as error:
        answer = {"status": 124, "output": (error.stdout or b"").decode("utf-8", "replace")}
    except (OSError, ValueError, sqlite3.Error) as error:
        answer = {"error": f"{type(error).__name__}: {error}"}
    say({"id": message["id"], "began_s": began_s, "ended_s": time.monotonic(), **answer})


def main() -> None:
    """Until the machine ends."""
    turn = threading.Lock()
    port = open(PORT, "r+b", buffering=0)  # noqa: SIM115 - until the machine ends

    def say(answer: dict[str, Any]) -> None:
        line = json.dumps(answer).encode() + b"\n"
        with turn:
            while line:
                line = line[port.write(line) or 0 :]

    say({"id": 0, "began_s": time.monotonic(), "ended_s": time.monotonic()})
    pending = b""
    while True:
        data = port.read(65536)
        if not data:  # the host is not there yet, or no more
            time.sleep(0.1)
            continue
        *lines, pending = (pending + data).split(b"\n")
        for line in lines:
            threading.Thread(target=serve, args=(json.loads(line), say), daemon=True).start()


main()
