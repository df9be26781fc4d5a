"""The everyday job on the page: a guided session on a simulated rig, to an accepted model, and back."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from playwright.sync_api import TimeoutError as PageTimeoutError

from tests.daemon.support.daemon_process import DaemonProcess
from tests.daemon.support.models import ModelRig
from tests.daemon.web.web_support import WebProcess
from tests.simulated.guided_operator import GuidedOperator
from tests.web.browser import open_live, violations
from tests.web.conftest import NewPage

pytestmark = [pytest.mark.browser, pytest.mark.timeout(2000)]

TARGET_MM = "6"
MOST_TAPS = 12
GUIDE_S, JOBS_S = 900.0, 900.0  # a busy computer is slow; a quiet one needs two minutes and one


def with_a_model_of_last_year(directory: Path) -> None:
    """Make a store in which model 1 was live once."""
    rig = ModelRig(directory)
    try:
        model = rig.models.get(rig.accepted())
        rig.store.update("models", {"id": model.id}, {"state": "retired"})
        change = {"model_id": model.id, "state": "retired", "reason": "the boom was rebuilt"}
        rig.store.insert("model_states", change | rig.store.instant(rig.clock.now()))
        rig.store.update("calibration_sessions", {"id": "a"}, {"excluded": "the boom was rebuilt since"})
    finally:
        rig.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[DaemonProcess]:
    with_a_model_of_last_year(tmp_path)
    daemon = DaemonProcess(tmp_path, "--sim", "--by-hand", "--rate", "10", "--seed", "1")
    try:
        daemon.wait("a fix", daemon.has_fix)
        yield daemon
    finally:
        daemon.stop()


class OperatorAtThePage(GuidedOperator):
    """Moves boom and station by hand, and presses what is to be pressed on the page."""

    def __init__(self, page: Page, daemon: DaemonProcess) -> None:
        super().__init__(self._ask)
        self._page, self._daemon = page, daemon
        self.looked = False

    def _ask(self, command: str, **arguments: Any) -> Any:
        if command == "session.confirm-prism":
            with contextlib.suppress(PageTimeoutError):  # the joints may have told it by now
                self._page.get_by_role("button", name="It is the right prism").first.click(timeout=3_000)
                self._page.wait_for_timeout(1000)
            return None
        if command == "simulation.visit" and not self.looked:
            self._look()
        return self._daemon.say(command, **arguments)

    def _press(self, step: Any) -> None:
        self._page.locator("#guide-action").get_by_role("button", name=step["button"], exact=True).click()
        self.taps += 1

    def _look(self) -> None:
        """At the first pose: what the page shows of it, in both colours."""
        self.looked = True
        page = self._page
        expect(page.locator("#guide-title")).to_contain_text("Go to pose 1")
        expect(page.get_by_role("img", name="Side view: the boom reaches")).to_be_visible()
        expect(page.locator(".boom polyline.there")).to_have_count(8)
        expect(page.locator(".joints li.to-go")).not_to_have_count(0)
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            assert violations(page) == [], f"the guide, {scheme}"


def test_a_guided_session_ends_with_an_accepted_model_and_goes_back(new_page: NewPage, rig: DaemonProcess) -> None:
    web = WebProcess(rig.config)
    try:
        page = new_page()
        open_live(page, f"{web.address}/now")
        page.get_by_role("button", name="Start a guided session").click()
        for prism in ("Prism w", "Prism b"):
            page.get_by_label(prism).uncheck()
        page.get_by_label("Target in mm").fill(TARGET_MM)
        page.get_by_role("button", name="Start", exact=True).click()
        expect(page.locator("#guide-title")).to_contain_text("Shoot control point")
        operator = OperatorAtThePage(page, rig)
        guide = operator.follow(lambda state: state["state"] != "open", limit_s=GUIDE_S)
        assert guide["state"] == "finished", guide
        assert operator.looked
        assert 1 + operator.taps + 3 <= MOST_TAPS, "with the start, the review, the acceptance and its confirmation"
        kept = rig.say("session.list")
        assert {session["operator"].partition(" (")[2] for session in kept if session["id"] != "a"} == {
            "page, approve)"
        }

        deadline = time.monotonic() + JOBS_S
        page.goto(f"{web.address}/now")
        review = page.get_by_role("button", name="Review the model")
        while not review.is_visible():
            assert rig.process.poll() is None, f"the daemon ended: {rig.log_text()[-3000:]}"
            failed = [job["error"] for job in rig.say("jobs.list") if job["state"] == "failed"]
            assert not failed, failed
            assert time.monotonic() < deadline, rig.say("jobs.list")
            page.wait_for_timeout(500)
        review.click()
        new = rig.say("model.list")[-1]["id"]
        page.get_by_role("button", name=f"Accept model {new}").click()
        expect(page.get_by_role("dialog")).to_contain_text("No model is live now; this is the first")
        page.get_by_role("dialog").get_by_role("button", name=f"Accept model {new}").click()
        expect(page.locator(f"[data-model='{new}'] .tag")).to_have_text("live", timeout=30_000)
        assert rig.say("status")["models"]["live"]["id"] == new

        page.get_by_text("Earlier models").click()
        page.get_by_role("button", name="Put model 1 back").click()
        expect(page.get_by_role("dialog")).to_contain_text(f"It takes the place of model {new}")
        page.get_by_role("dialog").get_by_role("button", name="Put model 1 back").click()
        expect(page.locator("[data-model='1'] .tag")).to_have_text("live", timeout=30_000)
        history = rig.say("model.show", id=1)["history"]
        assert (history[-1]["reason"], history[-1]["operator"].endswith("(page, approve)")) == ("put back", True)
        assert "Traceback" not in rig.log_text()
    finally:
        assert web.stop() == 0
