"""One browser for all tests of the page, and a page on a store of months."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from daemon.config.config import Config
from tests.daemon.web.web_support import WebProcess
from tests.web.browser import TABLET, chromium, launched
from tests.web.scene import served

NewPage = Callable[..., Page]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    if chromium() is None:
        pytest.skip("there is no Chromium here: apt install chromium")
    with launched() as browser:
        yield browser


@pytest.fixture
def new_page(browser: Browser) -> Iterator[NewPage]:
    """Make pages, each of a person of its own; an error in a script fails the test."""
    errors: list[str] = []
    with ExitStack() as stack:

        def make(**options: Any) -> Page:
            context = browser.new_context(**{"viewport": TABLET, **options})
            stack.callback(context.close)
            page = context.new_page()
            page.on("pageerror", lambda error: errors.append(str(error)))
            return page

        yield make
    assert not errors


@pytest.fixture(scope="session")
def months(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Config]:
    """The daemon of a rig that is months old."""
    with served(tmp_path_factory.mktemp("months")) as config:
        yield config


@pytest.fixture(scope="session")
def web(months: Config) -> Iterator[WebProcess]:
    process = WebProcess(months.state_directory / "rigcal.toml")
    yield process
    assert process.stop() == 0
