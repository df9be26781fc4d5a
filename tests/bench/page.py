"""The operator's page on a store of 24 hours: `python -m tests.bench.page [--seconds 60] [--keep DIRECTORY]`.

A simulated rig measures at its own speed into a store that holds a day already (made of copies of packed captures in
100 s of CPU; `--keep` keeps it for the next time). Measured: the first paint in Chromium
and how often what is shown changes there; CPU time of the web process with three clients; and with twenty clients, one
of them stalled, what acquisition loses, beside the same time without any. Exit status 1: a bar is missed.
"""

from __future__ import annotations

import argparse
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import ViewportSize

from tests.bench.year_store import build
from tests.daemon.support.daemon_process import DaemonProcess
from tests.daemon.web.web_support import WebProcess
from tests.web.browser import TABLET, chromium, launched, open_live

SAMPLES_OF_A_DAY = 1.131e8  # at the rates of `store_growth`: 24 hours
PAINT_S, RATE_HZ, CPU = 1.0, 5.0, 0.15
CELL = 58

PAINT = """() => new Promise(resolve => {
    const done = () => resolve(performance.getEntriesByName("first-contentful-paint")[0]?.startTime);
    new PerformanceObserver(done).observe({type: "paint", buffered: true}); })"""
# States that a browser takes, and changes of what it shows, a second.
CHANGES = """() => new Promise(resolve => {
    let n = 0; const seen = new MutationObserver(() => n++);
    seen.observe(document.querySelector("#screen"), {subtree: true, childList: true, characterData: true});
    let events = 0; const source = new EventSource("/api/live"); source.onmessage = () => events++;
    setTimeout(() => { source.close(); resolve([events / 5, n / 5]); }, 5000); })"""


def lost(status: dict[str, Any]) -> int:
    """Captures that found a queue full, and readings that a gap of lost frames says are missing."""
    acquisition = status["acquisition"]
    missed = sum(gap["missed"] for gap in acquisition["gap_counts"] if gap["reason"] == "frames_lost")
    return int(sum(link["dropped"] for link in acquisition["links"]) + missed)


@contextmanager
def listening(web: WebProcess, clients: int) -> Iterator[list[int]]:
    """Clients that take every state; the counts of what each has got."""
    counts = [0] * clients
    over = threading.Event()

    def listen(number: int) -> None:
        for _ in web.events():
            counts[number] += 1
            if over.is_set():
                return

    threads = [threading.Thread(target=listen, args=(number,)) for number in range(clients)]
    for thread in threads:
        thread.start()
    try:
        yield counts
    finally:
        over.set()
        for thread in threads:
            thread.join()


def stalled(web: WebProcess) -> socket.socket:
    """A client that asks for the state and takes nothing."""
    client = socket.create_connection((web.host, web.port))
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.sendall(f"GET /api/live HTTP/1.1\r\nHost: localhost:{web.port}\r\n\r\n".encode())
    return client


class Table:
    """Prints what was measured beside its bar."""

    def __init__(self) -> None:
        self.is_met = True

    def note(self, what: str, value: float, unit: str, bar: str, is_met: bool | None = None) -> None:
        """Print a line; `is_met` None where there is no bar."""
        verdict = "" if is_met is None else f"  bar {bar}: {'met' if is_met else 'MISSED'}"
        print(f"{what:{CELL}} {value:8.3f} {unit}{verdict}", flush=True)
        self.is_met &= is_met is not False


def measure(daemon: DaemonProcess, web: WebProcess, seconds: float, table: Table) -> None:
    """Measure the page of a rig that measures."""
    if chromium() is not None:
        with launched() as browser:
            page = browser.new_context(viewport=ViewportSize(width=TABLET["width"], height=TABLET["height"])).new_page()
            for screen in ("now", "health", "history"):
                page.goto(f"{web.address}/{screen}")
                paint_s = page.evaluate(PAINT) / 1e3
                table.note(f"first paint of {screen}", paint_s, "s", f"< {PAINT_S:g} s", paint_s < PAINT_S)
            open_live(page, f"{web.address}/health")
            events_hz, changes_hz = page.evaluate(CHANGES)
            table.note("states taken by the browser", events_hz, "Hz", f">= {RATE_HZ:g} Hz", events_hz >= RATE_HZ)
            table.note("changes of the screen", changes_hz, "per s", "")
    with listening(web, 3) as counts:
        began_s, before_s = time.monotonic(), web.cpu_s()
        time.sleep(seconds)
        share = (web.cpu_s() - before_s) / (time.monotonic() - began_s)
        rate_hz = min(counts) / (time.monotonic() - began_s)
    table.note("states to the slowest of three clients", rate_hz, "Hz", f">= {RATE_HZ:g} Hz", rate_hz >= RATE_HZ)
    table.note("CPU of the web process with three clients", share, "cores", f"<= {CPU:g}", share <= CPU)
    for clients in (0, 20):
        before = lost(daemon.say("status"))
        with ExitStack() as stack:
            if clients:
                stack.callback(stalled(web).close)
                stack.enter_context(listening(web, clients - 1))
            time.sleep(seconds)
        found = lost(daemon.say("status")) - before
        what = f"frames lost in {seconds:g} s with {clients} clients{', one stalled' if clients else ''}"
        table.note(what, found, "", "0", found == 0 if clients else None)


def main() -> int:
    """Measure; exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each measurement")
    parser.add_argument("--samples", type=float, default=SAMPLES_OF_A_DAY, help="that the store holds before")
    parser.add_argument("--keep", type=Path, help="directory for the store, kept; one that is there is used again")
    options = parser.parse_args()
    table = Table()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        directory = options.keep or Path(scratch)
        directory.mkdir(exist_ok=True)
        store = directory / "rigcal.sqlite"
        if not store.exists():
            build(store, options.samples, 1)
        print(f"a store of {store.stat().st_size / 2**20:.0f} MiB")
        daemon = DaemonProcess(directory, "--sim", "--rate", "1", jobs=False)
        stack.callback(daemon.stop)
        daemon.wait("a fix", daemon.has_fix)
        web = WebProcess(daemon.config)
        stack.callback(web.stop)
        measure(daemon, web, options.seconds, table)
    return 0 if table.is_met else 1


if __name__ == "__main__":
    sys.exit(main())
