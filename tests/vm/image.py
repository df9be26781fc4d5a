"""The virtual machine's image: a Debian 12 with the project's own package in it.

It is kept in `.cache/vm` by what it is made of. Everything comes from Debian's packages and from the package that
`make deb` builds of the last commit, which is installed without a network. The kernel is Debian's, and only the modules
that a rig or a fault needs are taken.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.deploy.packages import BUILD, PROJECT, Root, install, of_version, run

CACHE = PROJECT / ".cache" / "vm"
HERE = Path(__file__).parent
SUITE = "bookworm"
RELEASE = 12
SIZE = "6G"  # sparse
PACKAGES = "systemd,systemd-sysv,dbus,udev,kmod,iproute2,can-utils,e2fsprogs,python3,libgomp1,passwd,"
PACKAGES += "util-linux,ca-certificates"
# With what each of them needs. linux-image-cloud-amd64 has no CAN.
MODULES = """virtio_blk virtio_pci virtio_console virtio_rng ext4 9p 9pnet_virtio softdog autofs4 loop
    can can-raw vcan sja1000 kvaser_pci uhci-hcd usbserial ftdi_sio"""
INITRD_MODULES = "virtio_pci virtio_blk ext4"
INIT = """#!/bin/sh
mount -t devtmpfs dev /dev; mount -t proc proc /proc; mount -t sysfs sys /sys
for module in /mods/*.ko; do insmod "$module"; done
i=0; while [ ! -b /dev/vda ] && [ $i -lt 100 ]; do sleep 0.1; i=$((i+1)); done
mount -t ext4 -o rw /dev/vda /newroot || { echo "initrd: cannot mount /dev/vda"; poweroff -f; }
mount -o move /dev /newroot/dev; mount -o move /proc /newroot/proc; mount -o move /sys /newroot/sys
exec switch_root /newroot /sbin/init
"""
# Services that only cost boot time in a machine that is thrown away; the guest's clock is set by a check alone.
MASKED = """apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer e2scrub_reap.service
    fstrim.timer systemd-timesyncd.service getty@tty1.service serial-getty@ttyS0.service
    systemd-binfmt.service proc-sys-fs-binfmt_misc.automount"""
AGENT_UNIT = """[Unit]
Description=Does what the host asks for
After=multi-user.target
[Service]
ExecStart=/usr/bin/python3 -I /usr/local/sbin/guest-agent
Nice=-10
OOMScoreAdjust=-1000
[Install]
WantedBy=multi-user.target
"""
# Debian 12's QEMU emulates AVX2 wrongly where numpy sorts with it: wrong orders, and segmentation faults.
SITE = """import os
os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V3")
"""
OPERATOR, LOOKER, OTHER = "anna", "bert", "carl"  # members of rigcal, of rigcal-read, of neither
SERVICE = ("runuser", "-u", "rigcal", "--")
PYTHON = "/usr/lib/rigcal/bin/python"


class NoDebianError(Exception):
    """Debian's packages cannot be fetched; the message says why."""


@dataclass(frozen=True)
class Image:
    """Files of a machine.

    Attributes:
        disk: the root file system, raw; never written to.
        kernel, initrd: what is booted.
        next_package: the package in it under the next version.
    """

    disk: Path
    kernel: Path
    initrd: Path
    next_package: Path


def image(say: Callable[[str], None], cpu_of: Callable[[Image], dict[str, str]]) -> Image:
    """Return the image of the last commit; made where there is none of these contents yet.

    Args:
        say: told what is done.
        cpu_of: boots an image, and returns the name and the features that numba sees of its processor.

    Raises:
        NoDebianError: there is no Debian to begin with.
    """
    try:
        base = _base(say)
    except SystemExit as error:  # a command said why
        raise NoDebianError(str(error)[-300:]) from error
    place = CACHE / f"image-{_digest(base.name, _packaged(), _text(Path(__file__)), _text(HERE / 'guest_agent.py'))}"
    made = Image(place / "root.img", base / "vmlinuz", base / "initrd.img", place / "next.deb")
    if place.exists():
        return made
    for old in CACHE.glob("image-*"):
        shutil.rmtree(old)
    scratch = Path(tempfile.mkdtemp(dir=CACHE, prefix="image-new-"))
    say("building the package of the last commit")
    run(*BUILD, "--release", str(RELEASE), "--out", scratch)
    (package,) = scratch.glob("*.deb")
    version = run("dpkg-deb", "-f", package, "Version").strip()
    next_package = of_version(package, f"{version}.next", scratch)
    root = Root(scratch / "root")
    root.place.mkdir()
    run("tar", "-x", "--numeric-owner", "--exclude=./dev/*", "-f", base / "root.tar", "-C", root.place)
    say(f"installing {package.name} without a network")
    install(root, package)
    _set_up(root, base)
    _write_disk(root, scratch / "root.img")
    cpu = _cpu(cpu_of, Image(scratch / "root.img", made.kernel, made.initrd, next_package), say)
    say("compiling kernels for the machine's processor")
    root.run(*SERVICE, "env", *(f"{k}={v}" for k, v in cpu.items()), PYTHON, "-I", "-m", "daemon.warm_up")
    _write_disk(root, scratch / "root.img")
    shutil.rmtree(root.place)
    package.unlink()
    next_package.rename(scratch / "next.deb")
    scratch.rename(place)
    return made


def packaged_changes() -> str:
    """Return what of the package's sources is not committed: it is made of the last commit."""
    return run("git", "-C", PROJECT, "status", "--porcelain", "--", *_PACKAGED).strip()


_PACKAGED = (
    "calibration",
    "daemon",
    "deploy",
    "drivers",
    "rigcal",
    "simulators",
    "pyproject.toml",
    "requirements.lock",
)


def _packaged() -> str:
    """Names and contents of what goes into the package."""
    return run("git", "-C", PROJECT, "ls-tree", "HEAD", *_PACKAGED)


def _base(say: Callable[[str], None]) -> Path:
    """Return the directory of kernel, initrd and a Debian without the package."""
    depends = run("apt-cache", "depends", "linux-image-amd64")
    kernel = next((line.split()[1] for line in depends.splitlines() if "Depends: linux-image-" in line), "")
    if not kernel:
        raise SystemExit("apt knows no linux-image-amd64: is this a Debian?")
    place = CACHE / f"base-{_digest(PACKAGES, MODULES, INITRD_MODULES, INIT, kernel)}"
    if place.exists():
        return place
    CACHE.mkdir(parents=True, exist_ok=True)
    for old in CACHE.glob("base-*"):
        shutil.rmtree(old)
    say(f"fetching Debian {RELEASE} and its kernel")
    scratch = Path(tempfile.mkdtemp(dir=CACHE, prefix="base-new-"))
    scratch.chmod(0o755)
    _kernel(scratch, kernel)
    run("mmdebstrap", "--quiet", "--variant=apt", f"--include={PACKAGES}", SUITE, scratch / "root.tar")
    scratch.rename(place)
    return place


def _kernel(place: Path, name: str) -> None:
    """Unpack Debian's kernel: installing it would bring an initrd of its own and 400 MB of modules."""
    fetched = place / "fetched"
    fetched.mkdir(mode=0o777)
    fetched.chmod(0o777)  # apt fetches as a user of its own
    subprocess.run(["apt-get", "download", "-q", name], cwd=fetched, check=False, stdout=subprocess.DEVNULL)
    package = next(fetched.glob("*.deb"), None)
    if package is None:
        raise SystemExit(f"{name} cannot be fetched")
    unpacked = place / "unpacked"
    run("dpkg-deb", "-x", package, unpacked)
    (modules,) = (unpacked / "lib/modules").iterdir()
    run("depmod", "-b", unpacked, modules.name)
    shutil.copy(unpacked / "boot" / f"vmlinuz-{modules.name}", place / "vmlinuz")
    kept = place / "modules" / modules.name
    for wanted in MODULES.split():
        for found in _needed(unpacked, modules.name, wanted):
            target = kept / found.relative_to(modules)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(found, target)
    for index in ("modules.order", "modules.builtin", "modules.builtin.modinfo"):
        shutil.copy(modules / index, kept / index)
    _initrd(place, unpacked, modules.name)
    shutil.rmtree(unpacked)
    shutil.rmtree(fetched)


def _needed(root: Path, version: str, module: str) -> list[Path]:
    """Return the files of a module and of what it needs, in the order of loading."""
    said = run("modprobe", "-d", root, "-S", version, "-D", module)
    return [Path(line.split()[1]) for line in said.splitlines() if line.startswith("insmod")]


def _initrd(place: Path, unpacked: Path, version: str) -> None:
    tree = place / "initrd"
    for name in ("bin", "dev", "proc", "sys", "newroot", "mods"):
        (tree / name).mkdir(parents=True)
    shutil.copy(str(shutil.which("busybox")), tree / "bin/busybox")
    for name in ("sh", "mount", "insmod", "switch_root", "sleep", "poweroff"):
        (tree / "bin" / name).symlink_to("busybox")
    files = dict.fromkeys(f for module in INITRD_MODULES.split() for f in _needed(unpacked, version, module))
    for number, file in enumerate(files):
        shutil.copy(file, tree / "mods" / f"{number:02d}-{file.name}")
    (tree / "init").write_text(INIT)
    (tree / "init").chmod(0o755)
    names = "\n".join(str(path.relative_to(tree)) for path in [tree, *sorted(tree.rglob("*"))])
    cpio = subprocess.run(
        ["cpio", "--quiet", "-o", "-H", "newc"], cwd=tree, input=names.encode(), check=True, capture_output=True
    )
    (place / "initrd.img").write_bytes(cpio.stdout)
    shutil.rmtree(tree)


def _set_up(root: Root, base: Path) -> None:
    """Make the Debian one that boots in the machine, with an agent and people."""
    (version,) = (path.name for path in (base / "modules").iterdir())
    shutil.copytree(base / "modules", root.place / "lib/modules", dirs_exist_ok=True)
    run("depmod", "-b", root.place, version)
    files = {
        "etc/hostname": "rig\n",
        "etc/hosts": "127.0.0.1 localhost rig\n",
        "etc/fstab": "/dev/vda / ext4 errors=remount-ro 0 1\n"
        "host /host 9p trans=virtio,version=9p2000.L,msize=131072,nofail 0 0\n",
        "etc/modules-load.d/machine.conf": "9pnet_virtio\nvirtio_console\nvcan\nkvaser_pci\n",
        "etc/systemd/system/guest-agent.service": AGENT_UNIT,
        "usr/local/sbin/guest-agent": _text(HERE / "guest_agent.py"),
        "etc/machine-id": "",
        "etc/dpkg/dpkg.cfg.d/machine": "force-unsafe-io\n",
        "etc/python3.11/sitecustomize.py": SITE,
    }
    for name, text in files.items():
        path = root.place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (root.place / "host").mkdir()
    (root.place / "var/log/journal").mkdir(parents=True, exist_ok=True)
    root.run("passwd", "-d", "root")  # for a serial console, by hand
    root.run("systemctl", "-q", "mask", *MASKED.split())
    root.run("systemctl", "-q", "enable", "guest-agent.service")
    for name, groups in ((OPERATOR, "rigcal"), (LOOKER, "rigcal-read"), (OTHER, "")):
        root.run("useradd", "--create-home", "--groups", groups, name)
    shutil.rmtree(root.place / "var/cache/apt/archives", ignore_errors=True)
    for package in (root.place / "root").glob("*.deb"):
        package.unlink()


def _cpu(cpu_of: Callable[[Image], dict[str, str]], made: Image, say: Callable[[str], None]) -> dict[str, str]:
    """Return the variables by which numba compiles on this computer for the machine's processor.

    Compiled there they would take a quarter of an hour. The rig's own processor compiles for itself.
    """
    qemu = run("qemu-system-x86_64", "--version")
    known = CACHE / f"cpu-{_digest(qemu, platform.processor(), _text(PROJECT / 'requirements.lock'))}.json"
    if not known.exists():
        say("asking the machine for its processor")
        known.write_text(json.dumps(cpu_of(made)))
    cpu = json.loads(known.read_text())
    return {
        "NUMBA_CPU_NAME": cpu["name"],
        "NUMBA_CPU_FEATURES": cpu["features"],
        "CACHE_DIRECTORY": "/var/cache/rigcal",
    }


def _write_disk(root: Root, disk: Path) -> None:
    disk.unlink(missing_ok=True)
    options = "lazy_itable_init=1,lazy_journal_init=1"
    run("mke2fs", "-q", "-t", "ext4", "-E", options, "-d", root.place, disk, SIZE)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def missing() -> list[str]:
    """Return the programs that this computer lacks, and "root" where this is another user."""
    tools = (
        "qemu-system-x86_64",
        "qemu-img",
        "mmdebstrap",
        "mke2fs",
        "debugfs",
        "depmod",
        "cpio",
        "busybox",
        "unshare",
    )
    found = [tool for tool in tools if shutil.which(tool) is None]
    return found + ([] if os.geteuid() == 0 else ["root"])
