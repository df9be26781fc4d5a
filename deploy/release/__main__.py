"""`python -m deploy.release WHAT`: wheel, sdist or Debian packages of the last commit, or a whole release, in dist/."""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import tempfile
from pathlib import Path

from deploy.release import debian
from deploy.release.distributions import build_sdist, build_wheel, pack
from deploy.release.source import ROOT, Source, refusal

SUMS = "SHA256SUMS"
REFUSED = 3


def docs_archive(site: Path, source: Source, out: Path) -> Path:
    """Pack the built documentation.

    Returns:
        Path of the archive in `out`.
    """
    name = f"rigcal-{source.version}-docs"
    pages = {f"{name}/{path.relative_to(site)}": path.read_bytes() for path in site.rglob("*") if path.is_file()}
    if f"{name}/index.html" not in pages:
        raise SystemExit(f"{site} holds no documentation: `make docs` has not built it")
    pack(pages, out / f"{name}.tar.gz", source.epoch)
    return out / f"{name}.tar.gz"


def build(what: str, releases: list[int], out: Path, docs: Path | None) -> list[Path]:
    """Make what is asked for.

    Args:
        what: `wheel`, `sdist`, `deb` or `release`, which is all of them and the documentation.
        releases: of Debian.
        out: directory of what is made.
        docs: directory of the built documentation.

    Returns:
        What was made.
    """
    made: list[Path] = []
    with tempfile.TemporaryDirectory() as scratch:
        source = Source.of_head(Path(scratch) / "source", is_release=what == "release")
        out.mkdir(parents=True, exist_ok=True)
        if what in ("sdist", "release"):
            made.append(build_sdist(source, out))
        if what in ("wheel", "release"):
            made.append(build_wheel(source, out))
        if what in ("deb", "release"):
            wheel = build_wheel(source, Path(scratch) / "wheel")
            made += [path for release in releases for path in debian.build_package(source, wheel, release, out)]
        if docs is not None:
            made.append(docs_archive(docs, source, out))
    return made


def sums(made: list[Path]) -> str:
    """Return the lines that `sha256sum --check` takes."""
    return "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in sorted(made))


def main() -> int:
    """Command line; exit status 3 where the last commit may not be a release."""
    parser = argparse.ArgumentParser(prog="python -m deploy.release", description=__doc__)
    parser.add_argument("what", choices=("wheel", "sdist", "deb", "release", "check"))
    parser.add_argument("--release", type=int, action="append", choices=sorted(debian.PYTHONS), help="of Debian (all)")
    parser.add_argument("--docs", type=Path, help="the built documentation, packed too")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    options = parser.parse_args()
    if options.what in ("release", "check") and (why := refusal()) is not None:
        print(f"no release: {why}", file=sys.stderr)
        return REFUSED
    if options.what == "check":
        return 0
    os.umask(0o022)
    made = build(options.what, options.release or sorted(debian.PYTHONS), options.out, options.docs)
    lines = sums(made)
    if options.what == "release":
        (options.out / SUMS).write_text(lines, encoding="utf-8")
    print(lines, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
