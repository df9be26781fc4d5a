"""Debian packages in fresh Debian roots without a network: `make debtest`. Needs root, mmdebstrap and lintian.

For Debian 12 and 13: the package is built twice and is the same bytes; lintian finds no error; `apt install` without a
network; the unit passes systemd's own checks; a demo session runs as the service's user; an upgrade makes a backup
first; a downgrade is refused; a purge leaves the data, unless asked. Ends with status 1 at the first that fails.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).parents[2]
BUILD = (sys.executable, "-m", "deploy.release", "deb")
ROOTS = PROJECT / ".cache" / "debian"
RELEASES = {12: "bookworm", 13: "trixie"}
IN_ROOT = "python3,libgomp1,systemd,udev,passwd,ca-certificates"  # a usual computer has them
UNITS = ("rigcal-jobs.socket", "rigcal-jobs@0.service", "rigcal-clock.socket", "rigcal-clock@0.service")
# What a Debian in a directory needs of the kernel is there for the command alone: a run that is killed leaves no mount
# behind, below which whoever deletes the directory would delete this computer's devices.
_WITH_KERNEL = 'for system in proc dev; do mount --rbind "/$system" "$0/$system"; done && exec chroot "$0" "$@"'
EXPOSURE = 15  # tenths, of `systemd-analyze security`


def step(what: str) -> None:
    """Say what was shown."""
    print(f"  {what}", flush=True)


def run(*command: str | Path, **environment: str) -> str:
    """Run a command and return its output; SystemExit with the output where it fails."""
    done = subprocess.run(
        [str(word) for word in command],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))} ended with status {done.returncode}:\n{done.stdout}")
    return done.stdout


class Root:
    """A Debian in a directory, whose programs reach no network.

    Args:
        place: of its files.
    """

    def __init__(self, place: Path) -> None:
        self.place = place

    def run(self, *command: str, **environment: str) -> str:
        """Run a command in it; SystemExit where it fails."""
        return run(*self._inside(), *command, **self._environment(environment))

    def refused(self, *command: str) -> str:
        """Return what a command says that must fail."""
        done = subprocess.run(
            [*self._inside(), *command], env=self._environment({}), capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            raise SystemExit(f"{' '.join(command)} should have failed and has not")
        return done.stdout + done.stderr

    def _inside(self) -> list[str]:
        return ["unshare", "--net", "--mount", "sh", "-c", _WITH_KERNEL, str(self.place)]

    @staticmethod
    def _environment(more: dict[str, str]) -> dict[str, str]:
        path = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        return {"PATH": path, "LC_ALL": "C.UTF-8", "DEBIAN_FRONTEND": "noninteractive", "HOME": "/root", **more}


@contextlib.contextmanager
def fresh_root(release: int) -> Iterator[Root]:
    """A fresh Debian; its packages are fetched once, and kept."""
    ROOTS.mkdir(parents=True, exist_ok=True)
    archive = ROOTS / f"debian{release}.tar"
    if not archive.exists():
        scratch = archive.with_suffix(".part.tar")
        run("mmdebstrap", "--variant=apt", f"--include={IN_ROOT}", RELEASES[release], scratch)
        scratch.rename(archive)
    with tempfile.TemporaryDirectory() as directory:
        place = Path(directory) / "root"
        place.mkdir()
        run("tar", "-x", "--numeric-owner", "--exclude=./dev/*", "-f", archive, "-C", place)
        yield Root(place)


def package_of(release: int, out: Path) -> Path:
    """Build the package twice, which must be the same bytes."""
    built: list[Path] = []
    for name in ("first", "second"):
        run(*BUILD, "--release", str(release), "--out", out / name)
        built += (out / name).glob("*.deb")
    first, second = built
    if first.read_bytes() != second.read_bytes():
        raise SystemExit(f"{first.name}: two builds of one commit differ")
    step(f"{first.name}: {first.stat().st_size / 2**20:.0f} MiB, built twice, the same bytes")
    found = run("lintian", "--fail-on", "error", first)
    step(f"lintian: no errors, {found.count('W: ')} warnings")
    return first


def of_version(package: Path, version: str, out: Path) -> Path:
    """Return the same package under another version."""
    tree, target = out / f"tree-{version}", out / f"rigcal_{version}_amd64.deb"
    run("dpkg-deb", "-R", package, tree)
    was = run("dpkg-deb", "-f", package, "Version").strip()
    for script in (tree / "DEBIAN").iterdir():
        if script.name != "md5sums":
            script.write_text(script.read_text(encoding="utf-8").replace(was, version), encoding="utf-8")
    # Quickly made, and small: apt reads the whole several times.
    run("dpkg-deb", "--root-owner-group", "-Zzstd", "-z1", "-b", tree, target)
    shutil.rmtree(tree)
    return target


def install(root: Root, package: Path) -> str:
    """Install a package as a user would, without a network."""
    shutil.copy(package, root.place / "root" / package.name)
    return root.run("apt-get", "install", "-y", "--no-install-recommends", f"/root/{package.name}")


def try_release(release: int, package: Path, scratch: Path) -> None:
    """Install, use, upgrade, downgrade and purge the package in a fresh root."""
    with fresh_root(release) as root:
        said = install(root, package)
        expect("says what to set up" in said, said)
        step("installed without a network")
        expect(root.run("rigcal", "--version").startswith("rigcal, version"), "no version")
        expect(root.run("rigcal", "config", "check", "/etc/rigcal/rigcal.toml").count("good") == 1, "configuration")
        said = root.run("systemd-analyze", "verify", "rigcal.service", *UNITS)
        expect("rigcal" not in said, said)
        root.run("systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE}", "rigcal.service")
        step(f"the unit is sound, and its exposure at most {EXPOSURE / 10}")
        as_service = ("runuser", "-u", "rigcal", "--")
        root.run(*as_service, "rigcal", "demo", "--out", "/var/lib/rigcal/demo", "--rate", "50", HOME="/var/lib/rigcal")
        expect(any(root.place.glob("var/lib/rigcal/demo/**/report.html")), "the demo has made no report")
        step("a demo session went through to its report")
        (store,) = root.place.glob("var/lib/rigcal/demo/**/rigcal.sqlite")
        root.run("cp", "-p", f"/{store.relative_to(root.place)}", "/var/lib/rigcal/rigcal.sqlite")
        newer = of_version(package, "99.0", scratch)
        said = install(root, newer)
        backups = [*root.place.glob("var/lib/rigcal/before-upgrade/rigcal-*/backup.json")]
        expect(len(backups) == 1, said)
        step("an upgrade has made a backup first")
        shutil.copy(package, root.place / "root" / package.name)
        said = root.refused("apt-get", "install", "-y", "--allow-downgrades", f"/root/{package.name}")
        expect("it could not open the store" in said, said)
        expect(root.run("dpkg-query", "-W", "-f", "${Version}", "rigcal") == "99.0", "the downgrade went through")
        step("a downgrade is refused in a sentence")
        said = root.run("apt-get", "purge", "-y", "rigcal")
        expect("stay in /var/lib/rigcal" in said, said)
        expect((root.place / "var/lib/rigcal/rigcal.sqlite").exists(), "the purge has deleted the store")
        left = [p for d in ("usr/lib/rigcal", "etc/rigcal", "var/cache/rigcal") for p in [root.place / d] if p.exists()]
        expect(not left, f"the purge has left {left}")
        install(root, newer)
        root.run("apt-get", "purge", "-y", "rigcal", RIGCAL_PURGE_DATA="yes")
        expect(not (root.place / "var/lib/rigcal").exists(), "the data are still there")
        step("a purge is clean: it leaves the data, and deletes them where asked")


def expect(holds: object, said: str) -> None:
    """End with what was said, if something does not hold."""
    if not holds:
        raise SystemExit(said)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--release", type=int, action="append", choices=sorted(RELEASES), help="Debian release (all)")
    options = parser.parse_args()
    missing = [tool for tool in ("mmdebstrap", "lintian", "unshare", "chroot") if shutil.which(tool) is None]
    if missing or os.geteuid() != 0:
        print(f"not tried: packages need root and {', '.join(missing) or 'nothing else'}")
        return 0
    for release in options.release or sorted(RELEASES):
        print(f"Debian {release}", flush=True)
        with tempfile.TemporaryDirectory() as scratch:
            package = package_of(release, Path(scratch))
            try_release(release, package, Path(scratch))
    return 0


if __name__ == "__main__":
    sys.exit(main())
