"""Releases: one place says the version, and what may not be one is refused in a sentence."""

import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

import rigcal
from daemon.cli.main import main
from daemon.version import VERSION
from deploy.release.source import Source, changelog_versions, refusal, version_of
from tests.deploy.conftest import REPOSITORY, run

DATE = "2026-01-02T03:04:05Z"
CHANGELOG = "# Changelog\n\n## [1.2.0] - 2026-01-02\n\n- New.\n\n## [1.1.0] - 2026-01-01\n"


def git(root: Path, *arguments: str) -> None:
    who = {f"GIT_{role}_{part}": "x" for role in ("AUTHOR", "COMMITTER") for part in ("NAME", "EMAIL")}
    done = run("git", "-C", root, *arguments, **who, GIT_AUTHOR_DATE=DATE, GIT_COMMITTER_DATE=DATE)
    assert done.returncode == 0, done.stdout


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository with what a release is judged by, committed."""
    root = tmp_path / "repository"
    (root / "daemon").mkdir(parents=True)
    (root / "daemon/version.py").write_text('VERSION = "1.2.0"\n', encoding="utf-8")
    (root / "CHANGELOG.md").write_text(CHANGELOG, encoding="utf-8")
    git(root, "init", "-q")
    commit(root)
    return root


def commit(root: Path) -> None:
    git(root, "add", "-A")
    git(root, "commit", "-q", "--allow-empty", "-m", "x")


def test_the_version_is_said_in_one_place() -> None:
    assert rigcal.__version__ == version_of(REPOSITORY) == VERSION
    assert CliRunner().invoke(main, ["--version"]).output == f"rigcal, version {VERSION}\n"
    files = subprocess.run(
        ["git", "ls-files", "*.py", "*.toml"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    product = [name for name in files.stdout.split() if not name.startswith("tests/")]
    saying = [name for name in product if f'"{VERSION}"' in (REPOSITORY / name).read_text(encoding="utf-8")]
    assert saying == ["daemon/version.py"]


def test_the_changelog_begins_with_the_version_of_the_package() -> None:
    released = [name for name in changelog_versions(REPOSITORY) if name != "Unreleased"]
    assert released[0] == VERSION


def test_a_committed_version_with_its_entry_may_be_released(repository: Path, tmp_path: Path) -> None:
    assert refusal(repository) is None
    assert Source.of_head(tmp_path / "release", is_release=True, root=repository).version == "1.2.0"
    assert Source.of_head(tmp_path / "between", root=repository).version.startswith("1.2.0+git20260102.")
    git(repository, "tag", "v1.2.0")
    assert refusal(repository) is None
    assert Source.of_head(tmp_path / "tagged", root=repository).version == "1.2.0"


def test_changes_that_are_not_committed_are_refused(repository: Path) -> None:
    (repository / "new.py").write_text("", encoding="utf-8")
    assert refusal(repository) == "the work tree has 1 changes that are not committed, such as new.py"


@pytest.mark.parametrize(
    ("heading", "newest"), [("## [Unreleased]", "Unreleased"), ("## [1.1.9] - 2026-01-02", "1.1.9")]
)
def test_a_version_without_a_changelog_entry_is_refused(repository: Path, heading: str, newest: str) -> None:
    changed = CHANGELOG.replace("## [1.2.0] - 2026-01-02", heading)
    (repository / "CHANGELOG.md").write_text(changed, encoding="utf-8")
    commit(repository)
    why = refusal(repository)
    assert why is not None
    assert why.startswith(f"CHANGELOG.md begins with {newest}, and daemon/version.py says 1.2.0")


def test_a_version_that_another_commit_has_is_refused(repository: Path) -> None:
    git(repository, "tag", "v1.2.0")
    commit(repository)
    assert refusal(repository) == "v1.2.0 is another commit: raise the version in daemon/version.py"
