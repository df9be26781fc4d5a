"""deploy/bootstrap.sh where something is missing: the interpreter, a system package, the rights, the network.

The script runs as it is, in a small tree of its own; what is missing is made so through PATH, PYTHON and
pip's settings.
"""

import os
import shutil
import site
import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tests.deploy.conftest import DEPLOY, REPOSITORY, run

VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"
INTERPRETER = Path(sys.base_prefix) / "bin" / f"python{VERSION}"


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n" + text, encoding="utf-8")
    path.chmod(0o755)
    return path


class Tree:
    """A project with nothing but what the script reads, and programs of the test's choice before the system's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.programs = path / "programs"
        self.programs.mkdir()
        (path / "deploy").mkdir()
        shutil.copy(DEPLOY / "bootstrap.sh", path / "deploy")
        (path / "pyproject.toml").write_text("", encoding="utf-8")
        (path / "lock").write_text("numpy==2.4.6 \\\n    --hash=sha256:" + "0" * 64 + "\n", encoding="utf-8")

    def bootstrap(self, *options: str, **environment: str) -> CompletedProcess[str]:
        search = f"{self.programs}{os.pathsep}{os.environ['PATH']}"
        return run(
            self.path / "deploy/bootstrap.sh",
            *options,
            self.path / "venv",
            self.path / "lock",
            **({"PYTHON": str(INTERPRETER), "PATH": search} | environment),
        )

    def user(self, uid: int, *, sudo_needs_password: bool = True) -> None:
        executable(self.programs / "id", f"echo {uid}\n")
        executable(self.programs / "sudo", "exit 1\n" if sudo_needs_password else 'shift; exec "$@"\n')

    def record_apt(self) -> Path:
        log = self.path / "apt.log"
        executable(self.programs / "apt-get", f'echo "$@" >>"{log}"\n')
        return log

    def python_without_ensurepip(self) -> str:
        """As Debian's python3 comes: the venv module is there, what it needs is a package of its own."""
        missing = self.path / "missing"
        missing.mkdir()
        (missing / "ensurepip.py").write_text("raise ModuleNotFoundError('ensurepip')\n", encoding="utf-8")
        return str(executable(self.path / "python3", f'PYTHONPATH="{missing}" exec "{INTERPRETER}" "$@"\n'))


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


def test_a_python_that_is_too_old_is_named_with_its_version(tree: Tree) -> None:
    old = executable(tree.path / "python3", "echo 3.10\nexit 1\n")
    result = tree.bootstrap(PYTHON=str(old))
    assert result.returncode == 1
    assert result.stdout == (
        f"rigcal set-up: Python 3.11 or newer is needed; {old} is 3.10; "
        "install one, or name it: make PYTHON=/path/to/python3.11 ...\n"
    )


def test_an_interpreter_that_is_not_there_is_a_sentence_too(tree: Tree) -> None:
    result = tree.bootstrap(PYTHON="/nonexistent/python3")
    assert result.returncode == 1
    assert "no Python was found" in result.stdout


def test_without_rights_the_exact_command_is_given(tree: Tree) -> None:
    tree.user(1000)
    log = tree.record_apt()
    result = tree.bootstrap(PYTHON=tree.python_without_ensurepip())
    assert result.returncode == 1
    assert result.stdout == (
        "rigcal set-up: system packages are missing and may not be installed from here; "
        f"run: sudo apt-get install python{VERSION}-venv\n"
    )
    assert not log.exists()


@pytest.mark.parametrize("uid", [0, 1000])
def test_root_and_a_sudo_without_password_install_what_is_missing(tree: Tree, uid: int) -> None:
    tree.user(uid, sudo_needs_password=False)
    log = tree.record_apt()
    executable(tree.path / "venv/bin/python", "exit 0\n")
    result = tree.bootstrap(PYTHON=tree.python_without_ensurepip())
    assert result.returncode == 0, result.stdout
    update, install = log.read_text(encoding="utf-8").splitlines()
    assert update.endswith("update")
    assert install.endswith(f"install -y --no-install-recommends python{VERSION}-venv")


def test_a_tool_that_is_only_wanted_stops_nothing(tree: Tree) -> None:
    tree.user(1000)
    executable(tree.path / "venv/bin/python", "exit 0\n")
    libraries = ["-t", "libno-such.so.1=libno-such1", "-t", "libc.so.6=libc6"]
    result = tree.bootstrap("-t", "no-such-tool=its-package", "-t", "sh=dash", *libraries)
    assert result.returncode == 0, result.stdout
    assert "until you run: sudo apt-get install its-package libno-such1\n" in result.stdout


@pytest.mark.slow
@pytest.mark.long
def test_an_index_that_does_not_answer_is_a_sentence_after_pips_own_words(tree: Tree) -> None:
    result = tree.bootstrap(
        PIP_CONFIG_FILE=os.devnull, PIP_INDEX_URL="http://127.0.0.1:9/simple", PIP_RETRIES="0", PIP_FIND_LINKS=""
    )
    assert result.returncode == 1
    assert "No matching distribution found for numpy==2.4.6" in result.stdout
    assert result.stdout.splitlines()[-1].startswith("rigcal set-up: pip could not install the locked packages")


@pytest.mark.slow
@pytest.mark.long
def test_a_package_that_is_not_the_locked_one_is_refused(tree: Tree) -> None:
    wheel = tree.path / "wheels/numpy-2.4.6-py3-none-any.whl"
    wheel.parent.mkdir()
    wheel.write_bytes(b"something else")
    result = tree.bootstrap(PIP_CONFIG_FILE=os.devnull, PIP_NO_INDEX="1", PIP_FIND_LINKS=str(wheel.parent))
    assert result.returncode == 1
    assert "DO NOT MATCH THE HASHES" in result.stdout


def test_an_environment_that_is_up_to_date_is_left_alone(tree: Tree) -> None:
    # The environment's Python logs what it is asked to do; the second time pip is not among it.
    log = tree.path / "python.log"
    executable(tree.path / "venv/bin/python", f'echo "$@" >>"{log}"\n')
    assert tree.bootstrap("-e").returncode == 0
    assert log.read_text(encoding="utf-8").count("pip install") == 2
    log.unlink()
    assert tree.bootstrap("-e").returncode == 0
    assert "pip install" not in log.read_text(encoding="utf-8")


@pytest.mark.parametrize("changed", ["lock", "pyproject.toml"])
def test_a_change_of_lock_or_project_is_installed(tree: Tree, changed: str) -> None:
    log = tree.path / "python.log"
    executable(tree.path / "venv/bin/python", f'echo "$@" >>"{log}"\n')
    assert tree.bootstrap("-e").returncode == 0
    log.unlink()
    with (tree.path / changed).open("a", encoding="utf-8") as file:
        file.write("# changed\n")
    assert tree.bootstrap("-e").returncode == 0
    assert log.read_text(encoding="utf-8").count("pip install") == 2


def test_an_installation_that_failed_is_tried_again(tree: Tree) -> None:
    log = tree.path / "python.log"
    executable(tree.path / "venv/bin/python", 'case "$*" in *pip*) exit 1 ;; esac\n')
    assert tree.bootstrap("-e").returncode == 1
    executable(tree.path / "venv/bin/python", f'echo "$@" >>"{log}"\n')
    assert tree.bootstrap("-e").returncode == 0
    assert log.read_text(encoding="utf-8").count("pip install") == 2


def test_a_clone_that_is_named_as_its_package_is_no_package_to_its_parent(tmp_path: Path) -> None:
    """git names a clone after its project; Python finds it there as an empty package, before any finder is asked."""
    clone = tmp_path / "arm"
    clone.mkdir()
    tree = Tree(clone)
    (clone / "lock").write_text("# nothing\n", encoding="utf-8")
    project = '[project]\nname = "arm"\nversion = "1"\n[tool.setuptools]\npackages.find.include = ["arm*"]\n'
    (clone / "pyproject.toml").write_text(project, encoding="utf-8")
    (clone / "arm").mkdir()
    (clone / "arm" / "__init__.py").write_text("IS_HERE = True\n", encoding="utf-8")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", clone / "venv"], check=True)
    tools = f"import sys; sys.path.append({site.getsitepackages()[0]!r})\n"  # pip and setuptools, as they are here
    (next((clone / "venv").glob("lib/python*/site-packages")) / "tools.pth").write_text(tools, encoding="utf-8")
    result = tree.bootstrap("-e")
    assert result.returncode == 0, result.stdout
    python = clone / "venv/bin/python"
    found = subprocess.run(
        [python, "-c", "import arm; print(arm.IS_HERE)"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert found.stdout == "True\n", found.stderr


def test_setup_ends_with_what_comes_next_and_the_targets_that_need_it_do_not() -> None:
    def planned(target: str) -> str:
        return run("make", "--directory", str(REPOSITORY), "--dry-run", target).stdout

    assert "make demo shows a whole calibration" in planned("setup")
    assert "make demo shows a whole calibration" not in planned("demo")
