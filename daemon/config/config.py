"""The daemon's configuration: a TOML file, checked whole before anything is opened."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from calibration.rig.toml import LONGEST, parse_toml
from calibration.rig.toml_errors import as_toml, place, reason, section_at
from daemon.commands import INSTALLED_CONFIG, INSTALLED_SOCKET, CommandError, reading_socket
from daemon.config.sections import (
    CanSection,
    JobsSection,
    MetricsSection,
    NotifySection,
    ReportSection,
    Section,
    SessionsSection,
    StoreSection,
    TipSection,
    WebSection,
)
from drivers.can.bus_options import slcan_port
from drivers.files import read_text
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
MAX_SOCKET_PATH_BYTES = 107  # unix(7): sun_path holds 108 bytes with the terminating zero


class ConfigError(CommandError):
    """The configuration cannot be used; the message names file, key, what was found and what is allowed."""


class Config(Section):
    """Everything `rigcal run` needs to know.

    Attributes:
        rig: a shipped rig's name or a path to a rig file.
        state_directory: where store, models and reports live.
        socket: the control socket; when absent, `control.sock` in the runtime directory of the service, or in the state
            directory of a daemon that is not run as the service.
        read_group: group whose members may view the daemon's state but not change it, through a socket `status.sock`
            beside the control socket; no one when absent.
        metrics: where metrics are served; nowhere when absent.
        notify: where notices of alarms are sent; nowhere when absent.
        web: where `rigcal web` serves the page.
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
    def _there_is_one_station(self) -> Config:
        if len(self.station) > 1:
            raise ValueError("sessions use one station: keep one [[station]], and run a second rigcal for another one")
        return self

    @model_validator(mode="after")
    def _ports_differ(self) -> Config:
        ports = [link.channel for link in self.can if link.interface == "socketcan"]
        paths = [slcan_port(link.channel) for link in self.can if link.interface == "slcan"]
        ports += map(os.path.realpath, (*paths, *(station.serial.path for station in self.station)))
        if port := next((port for port in ports if ports.count(port) > 1), None):
            raise ValueError(f"two links use {port!r}; a port belongs to one link")
        return self

    @model_validator(mode="after")
    def _the_tip_may_be_sent(self) -> Config:
        if self.tip is None or self.tip.can is None:
            return self
        wanted = self.tip.can.link
        link = next((section for section in self.can if section.name == wanted), None)
        if link is None:
            raise ValueError(f"tip.can.link is {wanted!r}, but no [[can]] link has this name")
        if not link.allow_transmit:
            raise ValueError(f"tip.can needs allow_transmit = true on link {wanted!r}; without it CAN is listen-only")
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
        """Path of the token file of the page."""
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
        ConfigError: the configuration is wrong; the message has one line per wrong key.
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
        raise ConfigError(
            f"{source}: socket: {config.socket_path} is the socket of `read_group`; give `socket` another name"
        )
    sockets = [config.socket_path] + ([] if config.read_group is None else [reading_socket(config.socket_path)])
    longest = max(sockets, key=lambda path: len(os.fsencode(path)))
    if len(os.fsencode(longest)) > MAX_SOCKET_PATH_BYTES:
        raise ConfigError(
            f"{source}: socket: {longest!s:.200} is longer than the {MAX_SOCKET_PATH_BYTES} bytes a unix socket's "
            "path may have; set `socket` to a shorter one"
        )
    return config


def _installed_socket(source: Path) -> Path | None:
    """Return the installed service's socket for a client that reads its configuration; None for anything else.

    The service itself gets the directory from systemd.
    """
    is_client = source == INSTALLED_CONFIG.resolve() and "RUNTIME_DIRECTORY" not in os.environ
    return INSTALLED_SOCKET if is_client else None


def _require_no_zero_bytes(value: object, source: Path, key: str = "") -> None:
    """Refuse texts with zero bytes, at which the system would end a path, name or program argument."""
    if isinstance(value, str) and "\0" in value:
        raise ConfigError(f"{source}: {key}: contains a zero byte (\\u0000); remove it")
    items = value.items() if isinstance(value, dict) else enumerate(value, 1) if isinstance(value, list) else ()
    for name, inner in items:
        _require_no_zero_bytes(inner, source, f"{key}.{name!s:.{_QUOTED}}".lstrip("."))


def read_config(path: Path) -> Config:
    """Read and check a configuration file.

    Raises:
        ConfigError: the file cannot be read, or its configuration is wrong.
    """
    try:
        return parse_config(read_text(path, LONGEST), path.resolve())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 at byte {error.start}; save it as UTF-8") from error


def _sentence(error: ErrorDetails) -> str:
    """Return one pydantic error as `key: fault; allowed ...` or `key: fault, found ...`."""
    key = ".".join(str(part)[:_QUOTED] for part in place(error)) or "file"
    if error["type"] == "extra_forbidden":
        allowed = ", ".join(sorted(section_at(Config, error["loc"][:-1]).model_fields))
        return f"{key}: unknown key; allowed here: {allowed}"
    if error["type"] == "missing":
        return f"{key}: missing; it is required"
    message = reason(error, Config)[: 4 * _QUOTED]
    if error["loc"][-1:] == ("webhook_url",):  # it may hold a secret
        return f"{key}: {message}"
    found = error["input"]
    is_named = isinstance(found, str) and repr(found) in message
    if is_named or isinstance(found, dict):  # of a whole table the message names what is wrong in it
        return f"{key}: {message}"
    return f"{key}: {message}, found {as_toml(found)}"
