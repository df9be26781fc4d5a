"""The two forms in which Python's tools take a package: a wheel, and an sdist that gives the same wheel."""

from __future__ import annotations

import gzip
import io
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from deploy.release.source import Source, run

ZIP_EPOCH = 315_532_800  # zip knows no time before 1980
_SDIST = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"


def build_wheel(source: Source, out: Path) -> Path:
    """Make the wheel of a commit, or of the files of an sdist.

    Returns:
        Its path in `out`.
    """
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", scratch]
        run([*command, str(source.tree)], SOURCE_DATE_EPOCH=str(source.epoch))
        (wheel,) = Path(scratch).glob("rigcal-*.whl")
        out.mkdir(parents=True, exist_ok=True)
        _repack_zip(wheel, out / wheel.name, source.epoch)
    return out / wheel.name


def build_sdist(source: Source, out: Path) -> Path:
    """Make the sdist of a commit: what is installed, the build's own files, README, licence and changelog.

    Returns:
        Its path in `out`.
    """
    with tempfile.TemporaryDirectory() as scratch:
        run([sys.executable, "-c", _SDIST, scratch], cwd=source.tree)
        (sdist,) = Path(scratch).glob("rigcal-*.tar.gz")
        with tarfile.open(sdist) as old:
            files = {entry.name: content.read() for entry in old if (content := old.extractfile(entry))}
        out.mkdir(parents=True, exist_ok=True)
        pack(files, out / sdist.name, source.epoch)
    return out / sdist.name


def pack(files: Mapping[str, bytes], target: Path, epoch: int) -> None:
    """Write files as a compressed tar archive, in the order of their names, by one owner and of one instant.

    Args:
        files: name -> content.
        target: path of the archive.
        epoch: the instant, seconds.
    """
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name in sorted(files):
            entry = tarfile.TarInfo(name)
            entry.size, entry.mtime, entry.mode = len(files[name]), epoch, 0o644
            archive.addfile(entry, io.BytesIO(files[name]))
    target.write_bytes(gzip.compress(packed.getvalue(), 9, mtime=epoch))


def _repack_zip(wheel: Path, target: Path, epoch: int) -> None:
    """Write a wheel again with entries in the order of their names, of one instant and with one kind of rights."""
    date = datetime.fromtimestamp(max(epoch, ZIP_EPOCH), UTC).timetuple()[:6]
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for name in sorted(old.namelist()):
            entry = zipfile.ZipInfo(name, date)
            entry.external_attr = 0o100644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            new.writestr(entry, old.read(name))
