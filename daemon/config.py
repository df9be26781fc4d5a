"""The daemon's configuration: a TOML file, checked whole before anything is opened."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails

from calibration.rig.toml import LONGEST, parse_toml
from calibration.rig.toml_errors import as_toml, place, reason, section_at
from daemon.commands import INSTALLED_CONFIG, INSTALLED_SOCKET, CommandError, reading_socket
from drivers.can.bus_options import check_options
from drivers.can.tip_frames import FRAMES
from drivers.canopen.transmit import is_free
from drivers.files import read_text
from drivers.settings import Settings
from drivers.stations.config import StationConfig

_QUOTED = 100  # characters of a key
SIMULATED_CONFIG = """# Written by {written_by}. The simulated rig takes the place of the two ports.
rig = {rig}
state_directory = "."

[[can]]
channel = "can0"

[[station]]
serial.path = "/dev/rigcal-station"
"""
MAX_SOCKET_PATH_BYTES = 107  # unix(7): sun_path holds 108 bytes with the closing zero


class ConfigError(CommandError):
    """The configuration cannot be used; the message names file, key, what was found and what is allowed."""


class _Section(Settings):
    model_config = ConfigDict(allow_inf_nan=False)


class CanSection(_Section):
    """A CAN link.

    Attributes:
        name: which of the rig's channels it serves (their `link`).
        interface: kind of adapter, as python-can names it; `playback` plays a captured log as if its first frame came
            now.
        channel: interface, port or group, as python-can names it (`can0`, `/dev/ttyACM0`); for `playback` the log.
        bitrate: bit/s of the bus, for an slcan adapter; on socketcan systemd-networkd sets it.
        allow_transmit: rigcal may send on this bus: SYNC, and active set-up of the nodes listed.
        transmit_nodes: CANopen nodes that may be written to.
        sync_period_ms: send SYNC this often, so that all joints are sampled at one instant.
        options: further settings of the python-can interface.
    """

    name: str = "boom"
    interface: Literal["socketcan", "virtual", "udp_multicast", "slcan", "playback"] = "socketcan"
    channel: str
    bitrate: int | None = Field(default=None, ge=10_000, le=1_000_000)
    allow_transmit: bool = False
    transmit_nodes: tuple[int, ...] = ()
    sync_period_ms: int | None = Field(default=None, ge=1, le=10_000)
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _sending_is_said(self) -> CanSection:
        if self.interface == "playback" and self.allow_transmit:
            raise ValueError("a log that is played back cannot be sent to: remove allow_transmit")
        if not self.allow_transmit and (self.transmit_nodes or self.sync_period_ms):
            raise ValueError("transmit_nodes and sync_period_ms need allow_transmit = true; CAN is listen-only without")
        return self

    @field_validator("options", mode="before")
    @classmethod
    def _options_are_further_ones(cls, options: object) -> object:
        if isinstance(options, dict):
            check_options(options, frozenset(cls.model_fields))
        return options

    @field_validator("transmit_nodes")
    @classmethod
    def _nodes_exist(cls, nodes: tuple[int, ...]) -> tuple[int, ...]:
        if any(not 1 <= node <= 127 for node in nodes):
            raise ValueError("CANopen nodes are 1 to 127")
        return nodes


class SessionsSection(_Section):
    """Calibration sessions.

    Attributes:
        settle_s: how long the boom must have stood before its fixes count as one standstill.
        fixes_per_shot: how many good fixes are averaged for a control point.
        shot_timeout_s: how long to wait for them.
        control_tolerance_mm: a control point that is further off than this says that the set-up moved.
    """

    settle_s: float = Field(default=1.0, ge=0, le=3600)
    fixes_per_shot: int = Field(default=5, ge=1, le=10_000)
    shot_timeout_s: float = Field(default=60.0, gt=0, le=3600)
    control_tolerance_mm: float = Field(default=5.0, gt=0, le=1000)


class JobsSection(_Section):
    """Background jobs.

    Attributes:
        enabled: closed sessions trigger jobs.
        time_limit_s: a job that runs longer is stopped.
        max_attempts: how often a job is started that something interrupts; stops of the daemon do not count.
        seed: of every random choice in identification and residual training.
    """

    enabled: bool = True
    time_limit_s: float = Field(default=1800.0, gt=0, le=7 * 86_400)
    max_attempts: int = Field(default=3, ge=1)
    seed: int = Field(default=0, ge=0)


class StoreSection(_Section):
    """Contents of the store that are kept, and its backups. Sessions, their captures, and models are always kept.

    Attributes:
        keep_days: captures and readings outside sessions that are older are deleted; kept while there is room when
            absent.
        free_gb: where the disk and free pages of the store together have less room, in GiB, or less than a tenth of the
            disk, the oldest of them are deleted.
        backup_directory: where a backup is made every day, better on another disk; none are made when absent.
        backups: how many are kept.
    """

    keep_days: float | None = Field(default=None, ge=1, le=36_500)
    free_gb: float = Field(default=5.0, gt=0, le=1e6)
    backup_directory: Path | None = None
    backups: int = Field(default=3, ge=1)

    @property
    def free_bytes(self) -> int:
        """Room that the store should have."""
        return round(self.free_gb * 2**30)


class ReportSection(_Section):
    """The reports of jobs.

    Attributes:
        tolerance_mm: root mean square error on held-out fixes that the machine may have; reports then say whether it
            passed. Without it they say that no tolerance is stated.
    """

    tolerance_mm: float | None = Field(default=None, gt=0)


class TipCanSection(_Section):
    """The live corrected tip on a CAN link: two frames a time, as docs/reference/tip-frames.md has them.

    Attributes:
        link: name of a [[can]] link that may transmit.
        arbitration_id: 11-bit identifier of the first frame; the second has the next one. Both must be free in CANopen,
            680h to 6DFh.
    """

    link: str
    arbitration_id: int

    @property
    def identifiers(self) -> tuple[int, ...]:
        """Identifiers of all its frames."""
        return tuple(range(self.arbitration_id, self.arbitration_id + FRAMES))

    @field_validator("arbitration_id")
    @classmethod
    def _is_free(cls, first: int) -> int:
        if not all(is_free(identifier) for identifier in range(first, first + FRAMES)):
            raise ValueError("CANopen leaves 680h to 6DFh free, and two identifiers are needed: give 0x680 to 0x6DE")
        return first


class TipSection(_Section):
    """The live corrected tip.

    Attributes:
        prism: which prism's place it is, where a command names none.
        rate_hz: how often it is sent.
        can: where it is sent; nowhere when absent.
    """

    prism: str
    rate_hz: float = Field(default=5.0, gt=0, le=20)
    can: TipCanSection | None = None


class MetricsSection(_Section):
    """Metrics for Prometheus, on the loopback interface alone.

    Attributes:
        port: where they are served, as docs/reference/metrics.md says; 0 for any that is free, which the log names.
    """

    port: int = Field(ge=0, le=65535)


class NotifySection(_Section):
    """Notices of alarms to people elsewhere: by a webhook, by a command, or by both.

    Attributes:
        webhook_url: takes each message as JSON by POST; its key `text` is what chat services show.
        command: a program with its arguments, run without a shell; it gets each message as an e-mail on its standard
            input, as `sendmail ADDRESS` and `msmtp ADDRESS` take it.
        least: alarms below this severity are not told.
    """

    webhook_url: str | None = None
    command: tuple[str, ...] = ()
    least: Literal["warning", "critical"] = "warning"

    @field_validator("webhook_url")
    @classmethod
    def _is_http(cls, url: str | None) -> str | None:
        # What an error says of an address that no client takes would hold its secret.
        try:
            parts = urlsplit(url or "http://none")
            is_good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
            (parts.hostname or "").encode("idna")  # as the name is looked up: a label may be too long, or empty
        except ValueError:
            is_good = False
        is_plain = all("!" <= letter <= "~" for letter in url or "")
        if not is_good or not is_plain or parts.username is not None:
            raise ValueError(
                "give the address of a web server, without user, blanks or others than ASCII: https://HOST/PATH"
            )
        return url

    @field_validator("command")
    @classmethod
    def _is_a_program(cls, command: tuple[str, ...]) -> tuple[str, ...]:
        if command and not command[0].startswith("/"):
            raise ValueError("the program needs its whole path, as in ['/usr/bin/msmtp', 'someone@example.com']")
        return command

    @model_validator(mode="after")
    def _goes_somewhere(self) -> NotifySection:
        if self.webhook_url is None and not self.command:
            raise ValueError("give webhook_url, command, or both: notices need a way out")
        return self


class WebSection(_Section):
    """The operator's page, served by `rigcal web`.

    Attributes:
        host: address that it is served at; any but a loopback one needs a certificate and tokens.
        port: where.
        certificate, key: PEM files for TLS; both or neither.
        names: names by which browsers call this computer, beside its host name.
        tokens: file of the tokens; `web-tokens.json` in the state directory when absent.
    """

    host: str = "127.0.0.1"
    port: int = Field(default=8370, ge=0, le=65535)
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    tokens: Path | None = None

    def beside(self, base: Path) -> WebSection:
        """Return the same with paths that are relative to the configuration's directory."""
        paths = {name: getattr(self, name) for name in ("certificate", "key", "tokens")}
        return self.model_copy(update={name: path and base / path for name, path in paths.items()})


class Config(_Section):
    """Everything `rigcal run` needs to know.

    Attributes:
        rig: a shipped rig's name or a path to a rig file.
        state_directory: where store, models and reports live.
        socket: the control socket; when absent `control.sock` in the service's runtime directory, for another daemon in
            its state directory.
        read_group: whose members may look at the daemon's state and not change it, by a socket `status.sock` beside the
            control socket; no one when absent.
        metrics: where metrics are served; nowhere when absent.
        notify: where notices of alarms go; nowhere when absent.
        web: where the page is served, which `rigcal web` does.
    """

    rig: str
    state_directory: Path = Field(default_factory=lambda: Path(os.environ.get("STATE_DIRECTORY", "/var/lib/rigcal")))
    socket: Path | None = None
    read_group: str | None = Field(default=None, min_length=1)
    can: tuple[CanSection, ...] = ()
    station: tuple[StationConfig, ...] = ()
    sessions: SessionsSection = SessionsSection()
    jobs: JobsSection = JobsSection()
    store: StoreSection = StoreSection()
    report: ReportSection = ReportSection()
    tip: TipSection | None = None
    metrics: MetricsSection | None = None
    notify: NotifySection | None = None
    web: WebSection = WebSection()

    @model_validator(mode="after")
    def _names_differ(self) -> Config:
        names = [link.name for link in self.can] + [station.name for station in self.station]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ValueError(f"two links are called {doubled[0]!r}; every [[can]] and [[station]] needs its own name")
        return self

    @model_validator(mode="after")
    def _ports_differ(self) -> Config:
        if len(self.station) > 1:
            raise ValueError("sessions know one station: keep one [[station]], and give another a rigcal of its own")
        ports = [link.channel for link in self.can if link.interface == "socketcan"]
        paths = [link.channel for link in self.can if link.interface == "slcan"]
        ports += map(os.path.realpath, (*paths, *(station.serial.path for station in self.station)))
        if port := next((port for port in ports if ports.count(port) > 1), None):
            raise ValueError(f"two links are at {port!r}; a port belongs to one link")
        return self

    @model_validator(mode="after")
    def _the_tip_may_be_sent(self) -> Config:
        if self.tip is None or self.tip.can is None:
            return self
        wanted = self.tip.can.link
        link = next((section for section in self.can if section.name == wanted), None)
        if link is None:
            raise ValueError(f"tip.can.link is {wanted!r}, and no [[can]] link is called so")
        if not link.allow_transmit:
            raise ValueError(f"tip.can needs allow_transmit = true on link {wanted!r}; CAN is listen-only without")
        return self

    def own_identifiers(self, link: str) -> tuple[int, ...]:
        """Return the identifiers of rigcal's own messages on a CAN link."""
        can = self.tip.can if self.tip is not None else None
        return can.identifiers if can is not None and can.link == link else ()

    @property
    def store_path(self) -> Path:
        """Path of the store."""
        return self.state_directory / "rigcal.sqlite"

    @property
    def tokens_path(self) -> Path:
        """Path of the page's tokens."""
        return self.web.tokens or self.state_directory / "web-tokens.json"

    @property
    def models_directory(self) -> Path:
        """Directory that holds a directory for each model."""
        return self.state_directory / "models"

    @property
    def socket_path(self) -> Path:
        """Path of the control socket."""
        if self.socket is not None:
            return self.socket
        return Path(os.environ.get("RUNTIME_DIRECTORY", self.state_directory)) / "control.sock"


def parse_config(text: str, source: Path) -> Config:
    """Check a configuration.

    Args:
        text: TOML.
        source: the file, for messages and as the base of relative paths.

    Raises:
        ConfigError: every wrong key in one message, a line each.
    """
    try:
        raw = parse_toml(text)
    except ValueError as error:
        raise ConfigError(f"{source}: not valid TOML: {error}") from error
    _require_no_zero_bytes(raw, source)
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{source}: {_sentence(e)}" for e in error.errors())) from error
    base = source.parent
    rig = config.rig if "/" not in config.rig and not config.rig.endswith(".toml") else str(base / config.rig)
    config = config.model_copy(
        update={
            "rig": rig,
            "state_directory": base / config.state_directory,
            "socket": base / config.socket if config.socket else _installed_socket(source),
            "web": config.web.beside(base),
            "store": config.store.model_copy(
                update={
                    "backup_directory": base / config.store.backup_directory if config.store.backup_directory else None
                }
            ),
        }
    )
    if config.read_group is not None and config.socket_path == reading_socket(config.socket_path):
        raise ConfigError(f"{source}: socket: {config.socket_path} is where `read_group` looks; give it another name")
    sockets = [config.socket_path] + ([] if config.read_group is None else [reading_socket(config.socket_path)])
    longest = max(sockets, key=lambda path: len(os.fsencode(path)))
    if len(os.fsencode(longest)) > MAX_SOCKET_PATH_BYTES:
        raise ConfigError(
            f"{source}: socket: {longest!s:.200} is longer than the {MAX_SOCKET_PATH_BYTES} bytes a unix socket's "
            "path may have; set `socket` to a shorter one"
        )
    return config


def _installed_socket(source: Path) -> Path | None:
    """Return where the installed service listens, for whoever reads its configuration; systemd tells the service."""
    is_client = source == INSTALLED_CONFIG.resolve() and "RUNTIME_DIRECTORY" not in os.environ
    return INSTALLED_SOCKET if is_client else None


def _require_no_zero_bytes(value: object, source: Path, key: str = "") -> None:
    """Refuse texts that no path, name or argument of a program can have: the system takes them to end there."""
    if isinstance(value, str) and "\0" in value:
        raise ConfigError(f"{source}: {key}: holds a zero byte (\\u0000); take it out")
    items = value.items() if isinstance(value, dict) else enumerate(value, 1) if isinstance(value, list) else ()
    for name, inner in items:
        _require_no_zero_bytes(inner, source, f"{key}.{name!s:.{_QUOTED}}".lstrip("."))


def read_config(path: Path) -> Config:
    """Read and check a configuration file; ConfigError says what is wrong with it."""
    try:
        return parse_config(read_text(path, LONGEST), path.resolve())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 at byte {error.start}; save it as UTF-8") from error


def _sentence(error: ErrorDetails) -> str:
    """Return one pydantic error as `key: fault (allowed: ...)`."""
    key = ".".join(str(part)[:_QUOTED] for part in place(error)) or "file"
    if error["type"] == "extra_forbidden":
        allowed = ", ".join(sorted(section_at(Config, error["loc"][:-1]).model_fields))
        return f"{key}: unknown key; allowed here: {allowed}"
    if error["type"] == "missing":
        return f"{key}: missing; it is required"
    message = reason(error, Config)[: 4 * _QUOTED]
    if error["loc"][-1:] == ("webhook_url",):  # it may hold a secret
        return f"{key}: {message}"
    if isinstance(error["input"], dict):  # a whole table: the message names what is wrong in it
        return f"{key}: {message}"
    return f"{key}: {message}, found {as_toml(error['input'])}"
