"""Builds rigcal's wheel and its Debian packages: `make wheel`, `make deb`.

Both are made of the last commit, never of what lies in the work tree, and the same commit gives the same bytes:
instants are those of the commit, owners are root, and no compiled Python is packed.

A Debian package holds rigcal with all locked packages, for the Python of one Debian release: it installs without a
network, and nothing that Debian updates can change what runs. `python -m deploy.debian.build` is not how it is called:
it is a program of its own, `python deploy/debian/build.py deb [--release 12|13]... [--out DIRECTORY]`.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from email.parser import HeaderParser
from email.utils import formatdate
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
HOME = Path("usr/lib/rigcal")  # of the environment
PYTHONS = {12: "3.11", 13: "3.13"}  # Debian release -> its Python
# Wheels for these may be installed there: Debian 12 has glibc 2.36.
PLATFORMS = [f"manylinux_2_{minor}_x86_64" for minor in range(36, 4, -1)] + [
    "manylinux2014_x86_64",
    "manylinux1_x86_64",
]
BUILD_ONLY = {"pip", "setuptools"}
# Of deploy/: where a package has it. Those of /etc are edited by the site, and kept.
FILES = {
    "rigcal.service": "usr/lib/systemd/system/rigcal.service",
    "rigcal-jobs.socket": "usr/lib/systemd/system/rigcal-jobs.socket",
    "rigcal-jobs@.service": "usr/lib/systemd/system/rigcal-jobs@.service",
    "rigcal-clock.socket": "usr/lib/systemd/system/rigcal-clock.socket",
    "rigcal-clock@.service": "usr/lib/systemd/system/rigcal-clock@.service",
    "system-rigcaljobs.slice": "usr/lib/systemd/system/system-rigcaljobs.slice",
    "network.conf": "usr/share/doc/rigcal/network.conf",
    "rigcal-web.service": "usr/lib/systemd/system/rigcal-web.service",
    "rigcal.sysusers": "usr/lib/sysusers.d/rigcal.conf",
    "rigcal.modules-load": "usr/lib/modules-load.d/rigcal.conf",
    "rigcal.sysctl": "usr/lib/sysctl.d/60-rigcal.conf",
    "rigcal.toml": "etc/rigcal/rigcal.toml",
    "99-rigcal-station.rules": "etc/udev/rules.d/99-rigcal-station.rules",
    "80-can0.network": "etc/systemd/network/80-can0.network",
    "README.md": "usr/share/doc/rigcal/README.md",
    "debian/lintian-overrides": "usr/share/lintian/overrides/rigcal",
    "debian/copyright": "usr/share/doc/rigcal/copyright",
}
COMPLETIONS = {  # shell -> where it looks for what completes a program's commands
    "bash": "usr/share/bash-completion/completions/rigcal",
    "zsh": "usr/share/zsh/vendor-completions/_rigcal",
    "fish": "usr/share/fish/vendor_completions.d/rigcal.fish",
}
SCRIPTS = ("preinst", "postinst", "prerm", "postrm")
CONTROL = """Package: rigcal
Version: {version}
Architecture: amd64
Maintainer: rigcal contributors <rigcal@users.noreply.github.com>
Installed-Size: {size_kib}
Depends: libc6 (>= 2.36), python{python}, libgomp1, systemd | systemd-standalone-sysusers, passwd
Recommends: udev
Section: science
Priority: optional
Description: calibration of a drilling boom, by its joints and a total station
 rigcal reads joint encoders and length transducers over CAN and CANopen, and
 the fixes of a total station over a serial line, and finds the boom's true
 kinematic model: it identifies geometry and physical effects, and learns what
 remains.
 .
 The package has all that it needs beside Python itself. It neither enables
 nor starts the service: /usr/share/doc/rigcal/README.md says what to do first.
"""


@dataclass(frozen=True)
class Source:
    """The last commit, unpacked.

    Attributes:
        tree: its files.
        version: of the project; a commit that is no release has its date and number behind it.
        epoch: when it was made, seconds.
    """

    tree: Path
    version: str
    epoch: int

    @classmethod
    def of_head(cls, tree: Path) -> Source:
        """Unpack the last commit into a directory."""
        tree.mkdir(parents=True)
        archive = subprocess.run(["git", "-C", ROOT, "archive", "HEAD"], check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x", "-C", tree], input=archive, check=True)
        version = tomllib.loads((tree / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
        epoch, commit, day = _git("log", "-1", "--format=%ct %h %cd", "--date=format:%Y%m%d", "--abbrev=8").split()
        if f"v{version}" not in _git("tag", "--points-at", "HEAD").split():
            version += f"+git{day}.{commit}"
        return cls(tree, version, int(epoch))


def build_wheel(source: Source, out: Path) -> Path:
    """Make the wheel of a commit.

    Returns:
        Its path in `out`.
    """
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", scratch]
        _run([*command, str(source.tree)], SOURCE_DATE_EPOCH=str(source.epoch))
        (wheel,) = Path(scratch).glob("rigcal-*.whl")
        out.mkdir(parents=True, exist_ok=True)
        target = out / wheel.name
        _repack(wheel, target, source.epoch)
    return target


def _repack(wheel: Path, target: Path, epoch: int) -> None:
    """Write a wheel again with entries in the order of their names and rights of one kind."""
    when = max(epoch, 315_532_800)  # zip knows no time before 1980
    date = tuple(
        int(part)
        for part in subprocess.run(
            ["date", "-u", "-d", f"@{when}", "+%Y %m %d %H %M %S"], check=True, capture_output=True, text=True
        ).stdout.split()
    )
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for name in sorted(old.namelist()):
            entry = zipfile.ZipInfo(name, date)  # type: ignore[arg-type]
            entry.external_attr = 0o100644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            new.writestr(entry, old.read(name))


def build_package(source: Source, wheel: Path, release: int, out: Path) -> Path:
    """Make the package for a Debian release.

    Args:
        source: the commit.
        wheel: made of it.
        release: 12 or 13.
        out: directory of packages.

    Returns:
        Its path.
    """
    python = PYTHONS[release]
    version = f"{source.version}~deb{release}"
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch) / "root"
        _fill_environment(root / HOME, source, wheel, python)
        for name, place in FILES.items():
            _put(root / place, (source.tree / "deploy" / name).read_bytes())
        for unit in (root / "usr/lib/systemd/system").glob("*.service"):
            text = unit.read_text(encoding="utf-8").replace("/opt/rigcal/venv/bin/", f"/{HOME}/bin/")
            unit.write_text(text, encoding="utf-8")
        _link(root / "usr/bin/rigcal", "../lib/rigcal/bin/rigcal")
        for shell, place in COMPLETIONS.items():
            _put(root / place, completion(source.tree, shell))
        documents = root / "usr/share/doc/rigcal"
        _put(documents / "changelog.Debian.gz", _gzipped(_changelog(version, source.epoch)))
        _put(documents / "changelog.gz", _gzipped((source.tree / "CHANGELOG.md").read_text(encoding="utf-8")))
        _put(documents / "sbom.cdx.json", bill_of_materials(root / HOME, source, python).encode())
        _write_control(root, source, version, python)
        return _packed(root, out / f"rigcal_{version}_amd64.deb", source.epoch)


def _fill_environment(home: Path, source: Source, wheel: Path, python: str) -> None:
    """Make a virtual environment for another Python than this one: its packages, and what PEP 405 asks for."""
    site = home / f"lib/python{python}/site-packages"
    site.mkdir(parents=True)
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as lock:
        lock.write(locked_for(source.tree / "requirements.lock", python))
        lock.flush()
        where = ["--target", str(site), "--python-version", python, "--implementation", "cp"]
        where += [word for platform in PLATFORMS for word in ("--platform", platform)]
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--no-deps", "--only-binary", ":all:"]
        _run([*pip, *where, "--require-hashes", "-r", lock.name])
        _run([*pip, *where, str(wheel)])
    shutil.rmtree(site / "bin", ignore_errors=True)  # scripts that name this machine's Python
    for record in [*site.glob("*.dist-info/direct_url.json"), *site.glob("*.dist-info/RECORD")]:
        record.unlink()  # where the wheel lay; and lists with the scripts in them
    _put(home / "pyvenv.cfg", f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {python}\n".encode())
    _link(home / "bin/python", f"../../../bin/python{python}")
    _link(home / "bin/python3", "python")
    program = "#!/usr/lib/rigcal/bin/python -I\nimport sys\n\nfrom daemon.cli.main import main\n\nsys.exit(main())\n"
    _put(home / "bin/rigcal", program.encode(), mode=0o755)


def completion(tree: Path, shell: str) -> bytes:
    """Return the script by which a shell completes the commands of the rigcal in a directory."""
    command = [sys.executable, "-m", "daemon.cli.main", "completion", shell]
    return subprocess.run(command, cwd=tree, check=True, capture_output=True).stdout


def locked_for(lock: Path, python: str) -> str:
    """Return a lock file with the lines that hold for some Python, without their conditions.

    pip judges a condition by the Python that it runs on, not by the one that it installs for.
    """
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    kept = []
    for entry in re.split(r"\n(?=[a-z])", lock.read_text(encoding="utf-8")):
        first, _, rest = entry.partition("\n")
        if first.startswith("#"):
            continue
        wanted = Requirement(first.rstrip("\\ "))
        if wanted.name in BUILD_ONLY or (wanted.marker and not wanted.marker.evaluate(environment)):
            continue
        kept.append(f"{wanted.name}{wanted.specifier} \\\n{rest}")
    return "\n".join(kept) + "\n"


def bill_of_materials(home: Path, source: Source, python: str) -> str:
    """Return what the environment is made of, as CycloneDX 1.5 in JSON.

    Args:
        home: the environment.
        source: the commit.
        python: version of the Python that it is for.
    """
    components: list[dict[str, Any]] = []
    for found in sorted(
        distributions(path=[str(home / f"lib/python{python}/site-packages")]), key=lambda d: d.name.lower()
    ):
        name = found.name.lower().replace("_", "-")
        metadata = HeaderParser().parsestr(found.read_text("METADATA") or "")
        licence = metadata.get("License-Expression") or metadata.get("License") or ""
        component = {
            "type": "application" if name == "rigcal" else "library",
            "bom-ref": f"pkg:pypi/{name}@{found.version}",
            "name": name,
            "version": found.version,
            "purl": f"pkg:pypi/{name}@{found.version}",
        }
        if licence and "\n" not in licence:
            component["licenses"] = [{"license": {"name": licence}}]
        components.append(component)
    bom = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "timestamp": subprocess.run(
                ["date", "-u", "-d", f"@{source.epoch}", "+%Y-%m-%dT%H:%M:%SZ"],
                check=True,
                capture_output=True,
                text=True,
            ).stdout.strip(),
            "component": {"type": "application", "name": "rigcal", "version": source.version},
        },
        "components": components,
    }
    return json.dumps(bom, indent=1) + "\n"


def _write_control(root: Path, source: Source, version: str, python: str) -> None:
    control = root / "DEBIAN"
    control.mkdir()
    size_kib = sum(path.lstat().st_size + 1023 for path in _files(root)) // 1024
    text = CONTROL.format(version=version, size_kib=size_kib, python=python)
    _put(control / "control", text.encode())
    edited = [f"/{place}\n" for place in FILES.values() if place.startswith("etc/")]
    _put(control / "conffiles", "".join(edited).encode())
    for name in SCRIPTS:
        script = (source.tree / "deploy/debian" / name).read_text(encoding="utf-8").replace("@VERSION@", version)
        _put(control / name, script.encode(), mode=0o755)
    sums = [
        f"{hashlib.md5(p.read_bytes()).hexdigest()}  {p.relative_to(root)}\n"
        for p in _files(root)
        if not p.is_symlink()
    ]
    _put(control / "md5sums", "".join(s for s in sums if "  DEBIAN/" not in s and "  etc/" not in s).encode())


def _packed(root: Path, target: Path, epoch: int) -> Path:
    for path in [root, *root.rglob("*")]:
        if not path.is_symlink():
            is_executable = path.is_dir() or (path.parent.name in ("bin", "DEBIAN") and os.access(path, os.X_OK))
            path.chmod(0o755 if is_executable else 0o644)
    target.parent.mkdir(parents=True, exist_ok=True)
    # One thread: with more, the compressed bytes depend on how many there are.
    command = ["dpkg-deb", "--root-owner-group", "--threads-max=1", "-Zxz", "-z2", "--build", str(root), str(target)]
    _run(command, SOURCE_DATE_EPOCH=str(epoch))
    return target


def _changelog(version: str, epoch: int) -> str:
    entry = f"rigcal ({version}) unstable; urgency=medium\n\n  * See changelog.gz.\n"
    return f"{entry}\n -- rigcal contributors <rigcal@users.noreply.github.com>  {formatdate(epoch)}\n"


def _gzipped(text: str) -> bytes:
    return gzip.compress(text.encode(), 9, mtime=0)


def _files(root: Path) -> Iterator[Path]:
    return (path for path in sorted(root.rglob("*")) if path.is_symlink() or path.is_file())


def _put(path: Path, data: bytes, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    path.chmod(mode)


def _link(path: Path, to: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(to)


def _run(command: list[str], **environment: str) -> None:
    quiet = {"PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_ROOT_USER_ACTION": "ignore", "PIP_NO_INPUT": "1"}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, **quiet, **environment})


def _git(*arguments: str) -> str:
    return subprocess.run(["git", "-C", ROOT, *arguments], check=True, capture_output=True, text=True).stdout.strip()


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("wheel", "deb"))
    parser.add_argument("--release", type=int, action="append", choices=sorted(PYTHONS), help="Debian release (all)")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    options = parser.parse_args()
    os.umask(0o022)
    with tempfile.TemporaryDirectory() as scratch:
        source = Source.of_head(Path(scratch) / "source")
        wheel = build_wheel(source, options.out if options.what == "wheel" else Path(scratch))
        made = [wheel]
        if options.what == "deb":
            made = [
                build_package(source, wheel, release, options.out) for release in options.release or sorted(PYTHONS)
            ]
    for path in made:
        print(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
