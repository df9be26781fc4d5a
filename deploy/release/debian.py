"""Debian packages: rigcal with all locked packages, for the Python of one Debian release.

A package installs without a network, and nothing that Debian updates can change what runs (docs/decisions/0025).
Instants are those of the commit, owners are root, and no compiled Python is packed.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from email.parser import HeaderParser
from email.utils import formatdate
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from deploy.release.source import Source, run

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


def build_package(source: Source, wheel: Path, release: int, out: Path) -> tuple[Path, Path]:
    """Make the package for a Debian release, and its bill of materials beside it.

    Args:
        source: the commit.
        wheel: made of it.
        release: 12 or 13.
        out: directory of packages.

    Returns:
        Paths of package and bill of materials.
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
        materials = bill_of_materials(root / HOME, source, python).encode()
        _put(documents / "sbom.cdx.json", materials)
        _write_control(root, source, version, python)
        package = _packed(root, out / f"rigcal_{version}_amd64.deb", source.epoch)
        beside = package.with_suffix(".cdx.json")
        beside.write_bytes(materials)
        return package, beside


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
        run([*pip, *where, "--require-hashes", "-r", lock.name])
        run([*pip, *where, str(wheel)])
    shutil.rmtree(site / "bin", ignore_errors=True)  # scripts that name this machine's Python
    for suite in [path for path in site.rglob("tests") if path.is_dir()]:
        shutil.rmtree(suite, ignore_errors=True)  # the libraries' own tests, every fourth file to compile on a rig
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
        component: dict[str, object] = {
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
            "timestamp": datetime.fromtimestamp(source.epoch, UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
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
    run(command, SOURCE_DATE_EPOCH=str(epoch))
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
