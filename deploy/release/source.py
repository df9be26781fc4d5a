"""The last commit, of which everything is made: its files, its version, and whether it may be a release."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_VERSION = re.compile(r'^VERSION = "([^"]+)"$', re.MULTILINE)
_SECTION = re.compile(r"^## \[([^]]+)\](?: - \d{4}-\d\d-\d\d)?$", re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """A commit, unpacked.

    Attributes:
        tree: its files.
        version: of the project; a commit that is no release has its date and number behind it.
        epoch: when it was made, seconds.
    """

    tree: Path
    version: str
    epoch: int

    @classmethod
    def of_head(cls, tree: Path, *, is_release: bool = False, root: Path = ROOT) -> Source:
        """Unpack the last commit into a new directory.

        Args:
            tree: the directory.
            is_release: the commit is one, also where it has no tag yet.
            root: of the repository.
        """
        tree.mkdir(parents=True)
        archive = subprocess.run(["git", "-C", root, "archive", "HEAD"], check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x", "-C", tree], input=archive, check=True)
        version = version_of(tree)
        epoch, commit, day = git(root, "log", "-1", "--format=%ct %h %cd", "--date=format:%Y%m%d", "--abbrev=8").split()
        if not is_release and f"v{version}" not in git(root, "tag", "--points-at", "HEAD").split():
            version += f"+git{day}.{commit}"
        return cls(tree, version, int(epoch))


def version_of(tree: Path) -> str:
    """Return the version that `daemon/version.py` says."""
    found = _VERSION.search((tree / "daemon/version.py").read_text(encoding="utf-8"))
    if found is None:
        raise ValueError(f'{tree}/daemon/version.py has no line VERSION = "..."')
    return found[1]


def changelog_versions(tree: Path) -> list[str]:
    """Return the headings of the changelog, newest first."""
    return _SECTION.findall((tree / "CHANGELOG.md").read_text(encoding="utf-8"))


def refusal(root: Path = ROOT) -> str | None:
    """Return why the last commit may not be a release, in one sentence; None if it may."""
    changed = git(root, "status", "--porcelain").splitlines()
    if changed:
        return f"the work tree has {len(changed)} changes that are not committed, such as {changed[0][2:].strip()}"
    version = version_of(root)
    newest = next(iter(changelog_versions(root)), "nothing")
    if newest != version:
        return (
            f"CHANGELOG.md begins with {newest}, and daemon/version.py says {version}: give what is new "
            "a heading with the version and the date, or raise the version"
        )
    tagged = git(root, "tag", "--list", f"v{version}")
    if tagged and tagged not in git(root, "tag", "--points-at", "HEAD").split():
        return f"{tagged} is another commit: raise the version in daemon/version.py"
    return None


def git(root: Path, *arguments: str) -> str:
    """Return what git says about a repository."""
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.rstrip()


def run(command: list[str], *, cwd: Path | None = None, **environment: str) -> None:
    """Run a command whose output nobody needs, with pip's remarks left out."""
    quiet = {"PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_ROOT_USER_ACTION": "ignore", "PIP_NO_INPUT": "1"}
    subprocess.run(command, check=True, cwd=cwd, stdout=subprocess.DEVNULL, env={**os.environ, **quiet, **environment})
