"""Makes the pictures of the documentation: `python -m docs.pictures OUT`, which `make docs` calls.

All of them are what rigcal itself draws: the chain of a rig, figures and heads of reports on simulated machines,
screens of the operator's page on a simulated rig. What needs a browser is left out where there is no Chromium, and the
build leaves out its place in the text.
"""

from __future__ import annotations

import base64
import contextlib
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page
from playwright.sync_api import TimeoutError as PageTimeoutError

from tests.daemon.support.daemon_process import DaemonProcess
from tests.daemon.web.web_support import WebProcess
from tests.simulated.guided_operator import GuidedOperator
from tests.web.browser import DEADLINE_MS, PHONE, TABLET, chromium, launched, open_live

SOFT_JOINT = "joint_compliance@q2:compliance_rad_per_Nm=5e-6"
HEAD = {"width": 900, "height": 720}
CALM_MS = 20_000
STAGES = "Position error of every fix"  # what the alternative text of that figure begins with
_FIGURE = re.compile(r'<img alt="([^"]*)" src="data:image/svg\+xml;base64,([^"]*)"')


def main() -> None:
    """Make all pictures; reports are computed while the simulated rig drives."""
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(1) as pool:
        computed = pool.submit(of_reports, out, Path(scratch))
        if chromium() is None:
            print("There is no Chromium here (apt install chromium): the documentation gets no screenshots.")
        else:
            with guided(Path(scratch)) as address, launched() as browser:
                of_page(out, browser, address)
                of_heads(out, browser, computed.result())
        computed.result()


def of_page(out: Path, browser: Browser, address: str) -> None:
    """Take the operator's page, on a tablet and on a phone in the dark."""
    for name, viewport, scheme, screen, drawn in (
        ("page-guide", TABLET, "light", "guide", ".boom polyline.there"),
        ("page-now", PHONE, "dark", "now", ".tiles > *"),
    ):
        page = browser.new_page(viewport=viewport, color_scheme=scheme, device_scale_factor=1.5)
        open_live(page, f"{address}/{screen}")
        settled(page, drawn)
        page.screenshot(path=out / f"{name}.png")


def of_heads(out: Path, browser: Browser, reports: dict[str, Path]) -> None:
    """Take the first lines of reports."""
    for name, report in reports.items():
        page = browser.new_page(viewport=HEAD, color_scheme="light", device_scale_factor=1.5)
        page.goto(report.as_uri())
        page.screenshot(path=out / f"{name}.png")


def of_reports(out: Path, scratch: Path) -> dict[str, Path]:
    """Draw a chain, and take the figures that a report has; returns reports by the name of their picture."""
    for recording, name, poses in ((0, "train", 80), (1, "check", 60)):
        options = ["--seed", 3, "--recording", recording, "--effect", SOFT_JOINT, "--poses", poses]
        rigcal("simulate", "--rig", "ur10", *options, "--out", scratch / f"{name}.csv")
    rigcal("rig", "check", "swdt82", "--svg", out / "rig-check.svg")
    data = ["--rig", "ur10", "--data", scratch / "train.csv", "--tolerance", 0.1]
    rigcal("gap", *data, "--holdout", scratch / "check.csv", "--out", scratch / "gap")
    rigcal("calibrate", *data, "--effects", "joint_compliance@q2", "--residual", "none", "--out", scratch / "model")
    figures = dict(_FIGURE.findall((scratch / "model" / "report.html").read_text(encoding="utf-8")))
    stages = next(data for text, data in figures.items() if text.startswith(STAGES))
    (out / "report-stages.svg").write_bytes(base64.b64decode(stages))
    return {"report": scratch / "model" / "report.html", "gap": scratch / "gap" / "report.html"}


@contextlib.contextmanager
def guided(scratch: Path) -> Iterator[str]:
    """A simulated rig, some poses into a guided session; yields the address of its page."""
    directory = scratch / "rig"
    directory.mkdir()
    daemon = DaemonProcess(directory, "--sim", "--by-hand", "--rate", "4", "--seed", "3", jobs=False)
    try:
        daemon.wait("an answer", daemon.answers)
        daemon.say("simulation.aim", target="r")
        daemon.wait("a fix", daemon.has_fix)
        daemon.say("guide.start", new_setup={"id": "S1"}, prisms=["r"], poses=20, check_poses=4, operator="Ada")
        GuidedOperator(daemon.say).follow(lambda s: s["step"]["kind"] == "go_to_pose" and s["poses"]["done"] >= 4)
        web = WebProcess(daemon.config)
        try:
            yield web.address
        finally:
            web.stop()
    finally:
        daemon.stop()


def settled(page: Page, drawn: str) -> None:
    """Wait until the page shows what a selector names; for a while, until it has no alarm of a simulation held up."""
    page.wait_for_selector(drawn, state="attached", timeout=DEADLINE_MS)
    with contextlib.suppress(PageTimeoutError):
        page.wait_for_function("() => !document.querySelector('.alarm.critical')", timeout=CALM_MS)


def rigcal(*arguments: Any) -> None:
    """Give a command."""
    command = [sys.executable, "-m", "daemon.cli.main", *map(str, arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
