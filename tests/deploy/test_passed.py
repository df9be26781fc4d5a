"""Tests that take long are run again when what they test has changed, and only then."""

from pathlib import Path

from tests.passed import Passed


def sources(root: Path) -> Passed:
    (root / "daemon").mkdir()
    (root / "tests").mkdir()
    (root / "daemon/service.py").write_text("one")
    (root / "tests/test_long.py").write_text("long")
    (root / "tests/test_other.py").write_text("other")
    return Passed("vm.passed", ("daemon",), lambda path: path.name == "test_long.py", root)


def test_it_holds_until_a_file_that_is_tested_or_a_test_changes(tmp_path: Path) -> None:
    passed = sources(tmp_path)
    assert not passed.holds()
    passed.note()
    assert passed.holds()
    (tmp_path / "tests/test_other.py").write_text("changed")
    (tmp_path / "README.md").write_text("changed")
    assert passed.holds()
    (tmp_path / "tests/test_long.py").write_text("changed")
    assert not passed.holds()
    passed.note()
    assert passed.holds()
    (tmp_path / "daemon/new.py").write_text("")
    assert not passed.holds()


def test_what_changes_while_the_tests_run_has_not_passed(tmp_path: Path) -> None:
    passed = sources(tmp_path)
    assert not passed.holds()
    (tmp_path / "daemon/service.py").write_text("two")
    passed.note()
    assert not passed.path.exists()
