"""Debian's headless Chromium, driven by Playwright; and axe-core, which finds what keeps people from using a page."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

AXE = Path(__file__).parent / "vendor" / "axe" / "axe.min.js"
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
TABLET, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
OPTIONS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
DEADLINE_MS = 60_000


@functools.cache
def chromium() -> str | None:
    """Where Chromium is, installed where root may; None where there is none."""
    found = shutil.which("chromium")
    if found is None and os.geteuid() == 0 and shutil.which("apt-get"):
        subprocess.run(["apt-get", "install", "-y", "chromium"], check=False, capture_output=True)
        found = shutil.which("chromium")
    return found


@contextmanager
def launched() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=OPTIONS)
        yield browser
        browser.close()


def violations(page: Page) -> list[str]:
    """What axe-core finds on a page, a line each."""
    page.evaluate(AXE.read_text("utf-8"))
    found: dict[str, Any] = page.evaluate("tags => axe.run(document, {runOnly: tags})", TAGS)
    return [
        f"{one['id']} ({one['impact']}): {node['html'][:160]} {node['failureSummary'][:200]}"
        for one in found["violations"]
        for node in one["nodes"]
    ]


def open_live(page: Page, address: str) -> None:
    """Open an address and wait until what is shown is live."""
    page.goto(address)
    page.wait_for_selector("body[data-live=yes]", timeout=DEADLINE_MS)
    page.wait_for_selector("#screen > *", state="attached", timeout=DEADLINE_MS)
