"""Every screen as people meet it: in light and dark, by tablet, phone and keyboard, and with the connection lost."""

import contextlib
import os
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from daemon.alarms.library import library
from daemon.config.config import Config
from daemon.control.protocol import request
from daemon.control.server import ControlServer
from daemon.web.access import Role, TokenFile
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.web.web_support import WebProcess
from tests.web.browser import DEADLINE_MS, PHONE, TABLET, open_live, violations
from tests.web.conftest import NewPage
from tests.web.scene import served

pytestmark = pytest.mark.browser

SCREENS = ("now", "guide", "session", "models", "health", "history")
SHOWN = {  # what each screen shows of a store of months
    "now": "Model 3 is better and waits for you",
    "guide": "Start a guided session",
    "session": "Fixes and residuals",
    "models": "2.31 mm before, 1.22 mm after",
    "health": "too few poses: 3 of 20",
    "history": "Model 2 holds",
}
TOUCHED = "button, nav a, a.button, input:not([type=radio]):not([type=checkbox]), select, summary"
SMALL_JS = """touched => [...document.querySelectorAll(touched)]
    .filter(each => each.offsetParent && each.checkVisibility())
    .map(each => [each.textContent.trim() || each.id, each.getBoundingClientRect()])
    .filter(([, box]) => box.height < 47.5 || box.width < 47.5)
    .map(([name, box]) => `${name} ${box.width}x${box.height}`)"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("device", "size"), [("tablet", TABLET), ("phone", PHONE)])
def test_every_screen_is_usable_by_everyone(
    new_page: NewPage, web: WebProcess, device: str, size: Any, scheme: str
) -> None:
    page = new_page(viewport=size, color_scheme=scheme)
    found: list[str] = []
    for screen in SCREENS:
        open_live(page, f"{web.address}/{screen}")
        expect(page.locator("main")).to_contain_text(SHOWN[screen])
        page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
        page.wait_for_timeout(150)  # charts and unfolded parts are drawn with the next frames
        found += [f"{screen}: {line}" for line in violations(page)]
        found += [f"{screen}: too small for gloves: {line}" for line in page.evaluate(SMALL_JS, TOUCHED)]
        if not page.evaluate(
            "document.documentElement.scrollWidth <= innerWidth && main.scrollWidth <= main.clientWidth"
        ):
            found.append(f"{screen}: wider than the {device}")
    open_live(page, f"{web.address}/models")
    page.get_by_role("button", name="Accept model 3").click()
    expect(page.get_by_role("dialog")).to_contain_text("better beyond chance")
    found += [f"the confirmation: {line}" for line in violations(page)]
    assert not found, "\n".join(found)


def test_the_next_step_is_the_largest_thing_to_touch(new_page: NewPage, web: WebProcess) -> None:
    page = new_page()
    open_live(page, f"{web.address}/now")
    button = page.get_by_role("button", name="Review the model")
    box = button.bounding_box()
    assert box is not None
    assert box["height"] >= 72
    button.click()
    expect(page).to_have_url(f"{web.address}/models")


def test_the_keyboard_alone_is_enough(new_page: NewPage, web: WebProcess) -> None:
    page = new_page()
    open_live(page, f"{web.address}/now")
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the content")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#main")).to_be_focused()
    page.keyboard.press("Tab")
    expect(page.get_by_role("button", name="Review the model")).to_be_focused()
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineWidth")
    assert outline == "3px"
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Models", exact=True)).to_be_visible()
    page.get_by_role("button", name="Accept model 3").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_be_hidden()
    expect(page.get_by_role("button", name="Accept model 3")).to_be_focused()


def test_the_colours_can_be_changed_and_stay(new_page: NewPage, web: WebProcess) -> None:
    page = new_page(color_scheme="light")
    open_live(page, f"{web.address}/now")
    page.get_by_role("button", name="Change to dark colours").click()
    page.reload()
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"


def test_charts_with_nothing_to_show_are_sentences(new_page: NewPage, tmp_path: Path) -> None:
    (tmp_path / "rigcal.toml").write_text('rig = "swdt82"\nstate_directory = "."\n', encoding="utf-8")
    with idle_daemon(tmp_path):
        web = WebProcess(tmp_path / "rigcal.toml")
        try:
            page = new_page()
            open_live(page, f"{web.address}/history")
            for sentence in (
                "No check session was compared",
                "There is no sum",
                "No known control point",
                "No model was",
            ):
                expect(page.get_by_text(sentence)).to_be_visible()
            expect(page.locator("canvas, summary:visible, .chart:visible")).to_have_count(0)
        finally:
            assert web.stop() == 0


# ---- alarms ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def alarmed(months: Config, socket: Path) -> Iterator[None]:
    """The daemon of a rig where everything that rigcal watches is wrong at once."""
    status = request(months.socket_path, "status")
    status["alarms"]["active"] = [
        {
            **{"kind": rule.kind, "subject": "subject", "severity": rule.severity, "text": f"{rule.kind} is so"},
            **{"remedy": rule.remedy.replace("SUBJECT", "subject"), "since_utc_ns": 1, "age_s": 60.0},
        }
        for rule in library()
    ]
    server = ControlServer(socket, {"status": lambda _: status, "guide.state": lambda _: {"guide": None}})
    try:
        yield
    finally:
        server.close()


def test_each_alarm_is_shown_with_what_to_do(new_page: NewPage, months: Config, tmp_path: Path) -> None:
    with alarmed(months, tmp_path / "control.sock"):
        web = WebProcess(months.state_directory / "rigcal.toml", "--socket", str(tmp_path / "control.sock"))
        try:
            page = new_page()
            open_live(page, f"{web.address}/now")
            for rule in library():
                alarm = page.locator(f".alarm[data-kind={rule.kind}]")
                expect(alarm).to_contain_text(f"{rule.kind} is so")
                expect(alarm).to_contain_text(rule.remedy.replace("SUBJECT", "subject"))
                expect(alarm).to_contain_text("Critical" if rule.severity == "critical" else "Warning")
            expect(page.get_by_role("button", name="The zeros are checked")).to_be_visible()
            assert violations(page) == []
            heading, first = page.locator("#alarms-title").bounding_box(), page.locator(".alarm").first.bounding_box()
            assert heading is not None
            assert first is not None
            assert first["y"] - (heading["y"] + heading["height"]) >= 8, "the heading stands clear of the first alarm"
        finally:
            assert web.stop() == 0


# ---- lost connections ------------------------------------------------------------------------------------------------


def test_a_lost_connection_is_said_at_once_and_ends_by_itself(new_page: NewPage, months: Config) -> None:
    web = WebProcess(months.state_directory / "rigcal.toml")
    page = new_page()
    try:
        open_live(page, f"{web.address}/health")
        os.kill(
            web.process.pid, signal.SIGSTOP
        )  # as when a tablet leaves the network: nothing comes, and no word of it
        expect(page.locator("#banner")).to_be_visible(timeout=4000)
        expect(page.locator("#connection-text")).to_have_text("Not live")
        expect(page.locator("#banner")).to_contain_text(re.compile(r"the data shown are \d"), timeout=5000)
        os.kill(web.process.pid, signal.SIGCONT)
        page.wait_for_selector("body[data-live=yes]", timeout=30_000)
        expect(page.locator("#banner")).to_be_hidden()
    finally:
        os.kill(web.process.pid, signal.SIGCONT)
        assert web.stop() == 0
    expect(page.locator("#banner")).to_contain_text("The connection to the rig is lost", timeout=5000)
    web = WebProcess(months.state_directory / "rigcal.toml", "--port", str(web.port))
    try:
        page.wait_for_selector("body[data-live=yes]", timeout=30_000)
    finally:
        assert web.stop() == 0


def test_a_daemon_that_is_gone_is_said_at_once_and_comes_back(new_page: NewPage, tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.write_text('rig = "swdt82"\nstate_directory = "."\n', encoding="utf-8")
    over = threading.Event()
    ready = threading.Event()

    def run() -> None:
        with idle_daemon(tmp_path):
            ready.set()
            over.wait()

    daemon = threading.Thread(target=run)
    daemon.start()
    ready.wait()
    web = WebProcess(config)
    try:
        page = new_page()
        open_live(page, f"{web.address}/health")
        over.set()
        daemon.join()
        expect(page.locator("#banner")).to_contain_text("The daemon does not answer", timeout=3000)
        page.wait_for_timeout(2100)
        old = page.locator("td.old").count()
        assert old == page.locator("tbody tr").count() - page.locator("[aria-label=Links] tbody tr").count()
        with idle_daemon(tmp_path):
            page.wait_for_selector("body[data-live=yes]", timeout=10_000)
            expect(page.locator("#banner")).to_be_hidden()
    finally:
        over.set()
        assert web.stop() == 0


# ---- models ----------------------------------------------------------------------------------------------------------


def test_a_model_is_accepted_rejected_and_rolled_back_behind_a_confirmation(new_page: NewPage, tmp_path: Path) -> None:
    with served(tmp_path) as config:
        web = WebProcess(tmp_path / "rigcal.toml")
        try:
            page = new_page()
            open_live(page, f"{web.address}/models")
            page.get_by_role("button", name="Accept model 3").click()
            dialog = page.get_by_role("dialog")
            expect(dialog).to_contain_text("better beyond chance")
            dialog.get_by_role("button", name="Back").click()
            assert live(config) == 2, "nothing is done without the confirmation"
            page.get_by_role("button", name="Accept model 3").click()
            dialog.get_by_role("button", name="Accept model 3").click()
            expect(page.locator("[data-model='3'] .tag")).to_have_text("live", timeout=DEADLINE_MS)
            page.get_by_role("button", name="Roll back").click()
            expect(dialog).to_contain_text("Model 2 takes the place of model 3")
            dialog.get_by_role("button", name="Put model 2 back").click()
            expect(page.locator("[data-model='2'] .tag")).to_have_text("live", timeout=DEADLINE_MS)
            assert live(config) == 2
            history = request(config.socket_path, "model.show", {"id": 2})["history"]
            assert history[-1]["operator"].endswith("(page, approve)")
            page.locator("[data-model='2']").get_by_role("button", name="Reject").click()
            expect(dialog).to_contain_text("there is no corrected position from then on")
            dialog.get_by_text("Measured wrongly").click()
            dialog.get_by_role("button", name="Reject").click()
            expect(page.locator("[data-model='2'] .tag")).to_have_text("retired", timeout=DEADLINE_MS)
            assert request(config.socket_path, "status")["models"]["live"] is None
        finally:
            assert web.stop() == 0


def live(config: Config) -> int:
    return int(request(config.socket_path, "status")["models"]["live"]["id"])


# ---- roles -----------------------------------------------------------------------------------------------------------


def test_each_role_sees_its_own_buttons_and_is_refused_the_others(new_page: NewPage, months: Config) -> None:
    tokens = TokenFile(months.tokens_path)
    made = {role: tokens.add(f"someone who may {role.word}", role, 1) for role in Role}
    web = WebProcess(months.state_directory / "rigcal.toml", "--loopback-role", "read")
    try:
        for role in Role:
            page = new_page()
            open_live(page, f"{web.address}/models")
            page.get_by_role("button", name="Who you are").click()
            page.get_by_label("Token").fill(made[role])
            page.get_by_role("button", name="Close").click()
            expect(page.locator("#person-name")).to_contain_text(f"({role.word})")
            page.wait_for_selector("body[data-live=yes]")
            expect(page.locator("[data-model='3']")).to_be_visible()
            may_accept = page.get_by_role("button", name="Accept model 3")
            may_compare = page.get_by_role("button", name="Compare again")
            expect(may_accept).to_have_count(1 if role is Role.APPROVE else 0)
            expect(may_compare).to_have_count(1 if role >= Role.OPERATE else 0)
            statuses = [sent(page, command) for command in ("setup.new", "model.accept")]
            assert [status == 403 for status in statuses] == [role < Role.OPERATE, role < Role.APPROVE]
    finally:
        assert web.stop() == 0


def sent(page: Page, command: str) -> int:
    """Status of a command that the page's own scripts would not send."""
    send = """command => fetch("/api/command", {method: "POST", headers: {"Content-Type": "application/json"},
        body: JSON.stringify({command, arguments: {id: null}})}).then(answer => answer.status)"""
    return int(page.evaluate(send, command))
