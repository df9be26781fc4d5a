"""What MkDocs does besides: pages whose sources stand elsewhere in the repository, pictures that the build has made.

A link in a source is relative to the source, as it is for whoever reads it in the repository; here it becomes that of
the page. A picture that was not made, as where there is no Chromium, is left out with its caption.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "build" / "pictures"
ELSEWHERE = {  # source -> page
    "deploy/README.md": "how-to/install.md",
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "SECURITY.md": "project/security.md",
}
DECISIONS = "decisions/README.md"
_SOURCES = {page: source for source, page in ELSEWHERE.items()}
_LINK = re.compile(r"(?<=\]\()([^)\s#:]+)(?=[#)])")
_PICTURE = re.compile(
    r"(?m)^\[?!\[[^\]]*\]\((?:\.\./)*pictures/([\w.-]+)\)(?:\]\([^)]*\))?(?:\{[^}]*\})?\n(?:\n\*.*\*\n)?"
)


def on_files(files: Files, config: Any) -> Files:
    """Add pages from elsewhere and pictures."""
    for source, page in ELSEWHERE.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    for picture in sorted(PICTURES.glob("*")):
        files.append(File.generated(config, f"pictures/{picture.name}", abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return a page with its links as they are in the site, without pictures that were not made."""
    uri = page.file.src_uri
    base = os.path.dirname(_SOURCES.get(uri, f"docs/{uri}"))

    def link(found: re.Match[str]) -> str:
        target = os.path.normpath(os.path.join(base, found[1]))
        target = ELSEWHERE.get(target, target.removeprefix("docs/"))
        return os.path.relpath(target, os.path.dirname(uri))

    if uri == DECISIONS:
        markdown += "\n".join(("", *_decisions()))
    made = _PICTURE.sub(lambda found: found[0] if (PICTURES / found[1]).exists() else "", markdown)
    return _LINK.sub(link, made)


def _decisions() -> Iterator[str]:
    """Yield a line for each decision, the newest last."""
    for path in sorted((ROOT / "docs" / "decisions").glob("0*.md")):
        number, _, title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ").partition(" ")
        yield f"- {number} [{title}]({path.name})"
