"""A virtual machine: QEMU without KVM, booted from an image, obeyed by an agent inside, and pulled about from outside.

In the machine: `can0` and `can1`, two emulated cards on one bus; `/dev/ttyS1`, whose line ends at a USB adapter with a
serial number, which can be pulled out and put back; `/host`, a directory of this computer.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.vm.image import Image

ADAPTER = "RIG-4711"  # serial number of the station's adapter
BOOT_S = 900.0
SLOWEST = 30  # how much longer a busy computer may take than the machine thinks
# The machine's clocks count its instructions, 1 ns each, and go on by themselves only where it idles: how long a thing
# takes there does not depend on what else this computer does. One processor: several would have to take turns.
CLOCK = ("-smp", "1", "-icount", "shift=0,sleep=on")
OPTIONS = "console=ttyS0,115200 quiet loglevel=4 net.ifnames=0 mitigations=off nokaslr no_timer_check audit=0 panic=-1"


class MachineError(Exception):
    """The machine does not do what it is told; the message says what it did."""


class Answer:
    """What a command in the machine said.

    Attributes:
        status: its exit status.
        output: of both its streams.
        began_s, ended_s: instants of the machine's monotonic clock.
    """

    def __init__(self, message: Mapping[str, Any]) -> None:
        self.status = int(message.get("status", 0))
        self.output = str(message.get("output", ""))
        self.began_s, self.ended_s = float(message["began_s"]), float(message["ended_s"])
        self.error = str(message.get("error", ""))
        self.answer = message.get("answer")


class Machine:
    """A machine that runs; a context manager that leaves nothing of it behind.

    Attributes:
        booted_s: instant of its monotonic clock at which the agent answered first.
        shared: directory that is `/host` in it.

    Args:
        image: what is booted.
        directory: for its sockets, its console and what it writes to its disk.
        more: further options of QEMU.
    """

    def __init__(self, image: Image, directory: Path, more: Sequence[str] = ()) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.image, self.directory = image, directory
        self.shared = directory / "host"
        self.shared.mkdir(exist_ok=True)
        disk = directory / "disk.qcow2"
        subprocess.run(["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", image.disk, disk], check=True)
        self._log = (directory / "qemu.log").open("wb")
        self._process = subprocess.Popen(
            [*_command(image, directory, disk), *more], stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log
        )
        self._answers: dict[int, dict[str, Any]] = {}
        self._arrived = threading.Condition()
        self._number = 0
        self._qmp: _Qmp | None = None
        try:
            self._agent = _connected(directory / "agent", self._process)
            self._listener = threading.Thread(target=self._listen, daemon=True)
            self._listener.start()
            self.booted_s = Answer(self._answer(0, BOOT_S, "boot")).ended_s
        except BaseException:
            self.end()
            raise

    def __enter__(self) -> Machine:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Cut its power."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGKILL)
        self._process.wait()
        self._log.close()
        (self.directory / "disk.qcow2").unlink(missing_ok=True)

    # ---- in the machine ----------------------------------------------------------------------------------------------

    def run(self, command: str, timeout_s: float = 300.0) -> str:
        """Run a shell command as root, and return what it said; MachineError where it fails."""
        done = self.tried(command, timeout_s)
        if done.status:
            raise MachineError(f"{command}\nended with status {done.status}: {done.output.strip()[-2000:]}")
        return done.output

    def tried(self, command: str, timeout_s: float = 300.0) -> Answer:
        """Run a shell command as root that may fail."""
        return Answer(self._send({"run": command, "timeout_s": timeout_s}, timeout_s))

    def write(self, path: str, text: str) -> None:
        """Write a file."""
        answer = Answer(self._send({"write": path, "text": text}, 60.0))
        if answer.error:
            raise MachineError(f"{path}: {answer.error}")

    def ask(self, command: str, **arguments: Any) -> Answer:
        """Send the daemon a command by its control socket, from a process that is started for nothing else."""
        timeout_s = 600.0
        return Answer(self._send({"ask": command, "arguments": arguments, "timeout_s": timeout_s}, timeout_s))

    def query(self, sql: str, store: str) -> list[Any]:
        """Return the rows of a query of a database; MachineError where it cannot be read."""
        answer = Answer(self._send({"query": sql, "store": store}, 120.0))
        if answer.error:
            raise MachineError(f"{sql}: {answer.error}")
        return list(answer.answer or [])

    def now_s(self) -> float:
        """Its monotonic clock."""
        return Answer(self._send({"tell": "now"}, 60.0)).ended_s

    def _send(self, message: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        with self._arrived:
            self._number += 1
            number = self._number
            self._agent.sendall(json.dumps(message | {"id": number}).encode() + b"\n")
        return self._answer(number, SLOWEST * timeout_s, str(message)[:200])

    def _answer(self, number: int, timeout_s: float, what: str) -> dict[str, Any]:
        deadline = time.monotonic() + timeout_s
        with self._arrived:
            while number not in self._answers:
                self._arrived.wait(1.0)
                if self._process.poll() is not None:
                    raise MachineError(f"QEMU has ended: {_tail(self.directory / 'qemu.log')}")
                if time.monotonic() > deadline:
                    raise MachineError(f"no answer after {timeout_s:.0f} s: {what}\n{self.console()}")
            return self._answers.pop(number)

    def _listen(self) -> None:
        with contextlib.suppress(OSError), self._agent.makefile("rb") as lines:
            for line in lines:
                with contextlib.suppress(ValueError), self._arrived:
                    message = json.loads(line)
                    self._answers[message["id"]] = message
                    self._arrived.notify_all()

    # ---- from outside ------------------------------------------------------------------------------------------------

    def unplug_adapter(self) -> None:
        """Pull the station's USB adapter out."""
        self._monitor("device_del", id="adapter")

    def plug_adapter(self, serial: str = ADAPTER) -> None:
        """Put a USB adapter with that serial number in, at the end of the station's line."""
        given = {"driver": "usb-serial", "id": "adapter", "chardev": "station", "serial": serial}
        self._monitor("device_add", **given, **{"always-plugged": True})

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Stop the whole machine, its clocks included, as suspending it does."""
        self._monitor("stop")
        try:
            yield
        finally:
            self._monitor("cont")

    def console(self) -> str:
        """Return the end of what it wrote to its console."""
        return _tail(self.directory / "console.log")

    def cpu_s(self) -> float:
        """Return the processor time that it has cost this computer."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(") ")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _monitor(self, command: str, **arguments: Any) -> Any:
        if self._qmp is None:
            self._qmp = _Qmp(_connected(self.directory / "qmp", self._process))
        return self._qmp.say(command, **arguments)


class _Qmp:
    """QEMU's own control socket."""

    def __init__(self, connection: socket.socket) -> None:
        self._stream = connection.makefile("rwb")
        self._stream.readline()
        self.say("qmp_capabilities")

    def say(self, command: str, **arguments: Any) -> Any:
        self._stream.write(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        self._stream.flush()
        while True:  # events come in between
            message = json.loads(self._stream.readline())
            if "error" in message:
                raise MachineError(f"{command}: {message['error']['desc']}")
            if "return" in message:
                return message["return"]


def _command(image: Image, directory: Path, disk: Path) -> list[str]:
    device = ["-device"]
    line = directory / "line"  # from ttyS1 to the adapter
    command = ["qemu-system-x86_64", "-M", "pc", "-accel", "tcg,thread=single", "-cpu", "max", "-m", "2048", *CLOCK]
    command += ["-nodefaults", "-no-user-config", "-display", "none", "-no-reboot"]
    command += ["-kernel", str(image.kernel), "-initrd", str(image.initrd), "-append", OPTIONS]
    # First and explicit, so that it is /dev/vda whatever disks are added.
    command += ["-drive", f"file={disk},if=none,id=system,format=qcow2", *device, "virtio-blk-pci,drive=system"]
    shared = f"local,path={directory / 'host'},mount_tag=host,security_model=none,multidevs=remap"
    command += ["-virtfs", shared, *device, "virtio-rng-pci", *device, "virtio-serial-pci"]
    command += ["-chardev", f"socket,id=agent,path={directory / 'agent'},server=on,wait=off"]
    command += [*device, "virtserialport,chardev=agent,name=rigcal.agent"]
    command += ["-serial", f"file:{directory / 'console.log'}"]
    command += ["-chardev", f"socket,id=ttyS1,path={line},server=on,wait=off", "-serial", "chardev:ttyS1"]
    command += ["-chardev", f"socket,id=station,path={line}", *device, "piix3-usb-uhci"]
    command += [*device, f"usb-serial,id=adapter,chardev=station,serial={ADAPTER},always-plugged=on"]
    command += ["-object", "can-bus,id=bus", *device, "kvaser_pci,canbus=bus", *device, "kvaser_pci,canbus=bus"]
    return [*command, "-qmp", f"unix:{directory / 'qmp'},server=on,wait=off"]


def _connected(path: Path, process: subprocess.Popen[bytes]) -> socket.socket:
    deadline = time.monotonic() + 60.0
    while True:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(str(path))
        except OSError as error:
            connection.close()
            if process.poll() is not None or time.monotonic() > deadline:
                raise MachineError(f"QEMU does not start: {_tail(path.with_name('qemu.log'))}") from error
            select.select([], [], [], 0.05)
        else:
            return connection


def _tail(path: Path) -> str:
    return path.read_bytes()[-3000:].decode("utf-8", "replace") if path.exists() else ""


def wait_for(
    machine: Machine, what: str, look: Callable[[], Any], within_s: float = 120.0, pause_s: float = 0.5
) -> Any:
    """Return the first thing that `look` finds; MachineError after `within_s` seconds of the machine's own time."""
    until_s = machine.now_s() + within_s
    while not (found := look()):
        if machine.now_s() > until_s:
            raise MachineError(f"waited {within_s:.0f} s for {what}")
        time.sleep(pause_s)
    return found
