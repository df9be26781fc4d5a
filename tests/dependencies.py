"""Known vulnerabilities of the packages that the lock files pin, by pip-audit: `make check-deps`.

Both locks are asked about, for the oldest and the newest Python that a rig may have. Exit status 1 where a package has
a known vulnerability, 0 where none has. Where the advisories cannot be reached one line says so, and the status is 0.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).parents[1]
LOCKS = ("requirements.lock", "requirements-dev.lock")  # what a rig gets first
PYTHONS = ("3.11", "3.13")  # of Debian 12 and 13
UNREACHED = re.compile(r"Connection|ProxyError|Max retries|resolve|timed out|SSL|HTTPError|Forbidden|40[34]|50\d", re.I)


def pins(lock: Path, python: str) -> set[str]:
    """Return `name==version` of all packages that a lock has for a Python."""
    environment = {"python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux"}
    entries = (Requirement(line.rstrip("\\ ")) for line in lock.read_text("utf-8").splitlines() if line[:1].isalnum())
    return {f"{e.name}{e.specifier}" for e in entries if e.marker is None or e.marker.evaluate(environment)}


def audit(packages: set[str], *options: str) -> Iterator[tuple[str, str]]:
    """Yield each vulnerable package, as it is pinned, with a sentence about one vulnerability.

    Args:
        packages: as `pins` gives them.
        options: further ones of pip-audit.

    Raises:
        ConnectionError: the advisories cannot be reached.
        RuntimeError: pip-audit has failed otherwise.
    """
    with tempfile.TemporaryDirectory() as scratch:
        wanted, told = Path(scratch, "pins.txt"), Path(scratch, "told.json")
        wanted.write_text("\n".join(sorted(packages)) + "\n", encoding="utf-8")
        command = [sys.executable, "-m", "pip_audit", "--requirement", str(wanted), "--no-deps", "--disable-pip"]
        command += ["--format", "json", "--output", str(told), "--progress-spinner", "off", *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not told.exists():
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            raise (ConnectionError if UNREACHED.search(done.stderr) else RuntimeError)(last)
        answers = json.loads(told.read_text(encoding="utf-8"))["dependencies"]
        left_out = [one for one in answers if "skip_reason" in one]
        if len(left_out) == len(answers):
            raise ConnectionError(left_out[0]["skip_reason"])
        for one in left_out:
            print(f"not audited: {one['name']}: {one['skip_reason']}")
        for one in answers:
            for known in one.get("vulns", ()):
                mended = ", ".join(known["fix_versions"]) or "no version yet"
                names = ", ".join([known["id"], *known["aliases"]])
                yield f"{one['name']}=={one['version']}", f"{names}; mended in {mended}"


def main(*options: str) -> int:
    """Audit, print, and return the exit status."""
    on_rig = {python: pins(PROJECT / LOCKS[0], python) for python in PYTHONS}
    found: set[str] = set()
    count = 0
    for python in PYTHONS:
        packages = on_rig[python] | pins(PROJECT / LOCKS[1], python)
        count = max(count, len(packages))
        try:
            for package, what in audit(packages, *options):
                where = "on rigs" if package in on_rig[python] else "for development alone"
                found.add(f"{package} ({where}): {what}")
        except ConnectionError as error:
            print(f"{' and '.join(LOCKS)} were NOT audited: no advisories can be reached ({error})")
            return 0
    for line in sorted(found):
        print(line)
    print(
        f"{count} packages of {' and '.join(LOCKS)} for Python {', '.join(PYTHONS)}: {len(found)} vulnerabilities known"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
