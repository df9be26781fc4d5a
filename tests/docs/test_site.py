"""The site is built strictly, asks nobody for anything, and its references say what the code says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest

from docs.references.__main__ import PAGES, REFERENCE
from tests.docs.pages import ROOT

SOURCES = ("calibration", "daemon", "deploy", "docs", "drivers", "rigcal", "simulators", "tests")
LOADED = {
    **{"link": "href", "script": "src", "img": "src", "iframe": "src", "source": "src", "embed": "src"},
    **{"video": "src", "audio": "src", "object": "data", "use": "href", "image": "href"},
}
ROOMS = "tests|daemon|drivers|calibration|simulators|rigcal|deploy|docs"
PATH = re.compile(rf"(?<![\w/.-])(?:{ROOMS})/[\w./*-]*")
MODULE = re.compile(rf"(?<![\w/.-])(?:{ROOMS})(?:\.\w+){{2,}}(?![\w/])")
OUTSIDE = re.compile(r"(?i)^\s*(https?:)?//")


@pytest.mark.parametrize("name", PAGES)
def test_a_reference_is_what_the_code_says(name: str) -> None:
    assert (REFERENCE / name).read_text(encoding="utf-8") == PAGES[name](), "make it anew: python -m docs.references"


def test_every_page_that_a_file_names_is_there() -> None:
    for path in sources():
        for name in re.findall(r"\bdocs/[\w/-]+\.(?:md|yaml)", path.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{path.relative_to(ROOT)} names {name}"


def test_every_file_and_module_that_a_page_names_is_there() -> None:
    """Backticked paths and dotted names; `NAME` stands for what a reader adds, and a `*` for any text."""
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for page in listed.splitlines():
        for code in re.findall(r"`([^`\n]+)`", (ROOT / page).read_text(encoding="utf-8")):
            for name in PATH.findall(code):
                if "NAME" not in name:
                    assert any(ROOT.glob(name.rstrip("./"))), f"{page} names {name}"
            for name in MODULE.findall(code):
                assert is_there(name), f"{page} names {name}"


def is_there(dotted: str) -> bool:
    """Whether a module is there, or the one that a name is said to be of says that name."""
    path, _, last = (ROOT / dotted.replace(".", "/")).as_posix().rpartition("/")
    if any(Path(f"{path}/{last}{ending}").exists() for ending in ("", ".py")):
        return True
    files = [file for file in (Path(f"{path}.py"), Path(path, "__init__.py")) if file.exists()]
    return any(re.search(rf"\b{last}\b", file.read_text(encoding="utf-8")) for file in files)


def sources() -> Iterator[Path]:
    yield from (ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md", "Makefile"))
    for name in SOURCES:
        for ending in ("py", "md", "toml", "sh", "conf", "html", "js"):
            yield from (path for path in (ROOT / name).rglob(f"*.{ending}") if "vendor" not in path.parts)


class Loads(HTMLParser):
    """Collects what a page makes a browser load."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.addresses += [given[LOADED[tag]]] if LOADED.get(tag) in given else []
        self.addresses += [part.split()[0] for part in given.get("srcset", "").split(",") if part.strip()]
        self.addresses += re.findall(r"url\(['\"]?([^'\")]+)", given.get("style", ""))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.mark.slow
def test_the_site_asks_nobody_for_anything(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 60
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loads = Loads()
        loads.feed(text)
        assert loads.addresses, page
        assert not [address for address in loads.addresses if OUTSIDE.match(address)], page
        assert 'class="mermaid"' not in text, f"{page}: the theme would load mermaid from elsewhere"
    for style in site.rglob("*.css"):
        assert not re.search(r"""(url\(|@import)\s*['"]?(https?:)?//""", style.read_text(encoding="utf-8")), style


@pytest.mark.slow
def test_the_search_works_without_a_server(site: Path) -> None:
    home = (site / "index.html").read_text(encoding="utf-8")
    shim = re.findall(r'<script src="([^"]*iframe-worker[^"]*)"', home)
    assert shim
    assert (site / shim[0]).is_file()
    assert "backlash" in (site / "search" / "search_index.js").read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_page_is_two_clicks_from_the_home_page(site: Path) -> None:
    def linked(page: Path) -> set[Path]:
        targets = re.findall(r'href="([^"#:]+\.html)', page.read_text(encoding="utf-8"))
        return {(page.parent / target).resolve() for target in targets}

    home = site.resolve() / "index.html"
    first = linked(home)
    second = {page for one in first for page in linked(one)}
    everything = {page.resolve() for page in site.rglob("*.html")} - {site.resolve() / "404.html"}
    assert everything <= {home} | first | second
