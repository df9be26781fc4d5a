"""The tables of the configuration and the keys of each."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import ConfigDict, Field, field_validator, model_validator

from drivers.can.bus_options import check_channel, check_options
from drivers.can.tip_frames import FRAMES
from drivers.canopen.transmit import is_free
from drivers.settings import Settings


class Section(Settings):
    """One table of the configuration."""

    model_config = ConfigDict(allow_inf_nan=False)


class CanSection(Section):
    """A CAN link.

    Attributes:
        name: name of the link, by which the rig's channels refer to it (their `link`).
        interface: kind of adapter, as python-can names it; `playback` plays a captured log as if its first frame
            arrived now.
        channel: interface, port or group, as python-can names it (`can0`, `/dev/ttyACM0`); for `playback` the log.
        bitrate: bit/s of the bus, for an slcan adapter; on socketcan systemd-networkd sets it.
        allow_transmit: rigcal may send on this bus: SYNC, and active set-up of the nodes listed.
        transmit_nodes: CANopen nodes that may be written to.
        sync_period_ms: period at which SYNC is sent, so that all joints are sampled at one instant.
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
    def _channel_is_of_the_interface(self) -> CanSection:
        check_channel(self.interface, self.channel)
        return self

    @model_validator(mode="after")
    def _sending_is_said(self) -> CanSection:
        if self.interface == "playback" and self.allow_transmit:
            raise ValueError("nothing can be sent to a log that is played back; remove allow_transmit")
        if not self.allow_transmit and (self.transmit_nodes or self.sync_period_ms):
            raise ValueError(
                "transmit_nodes and sync_period_ms need allow_transmit = true; without it CAN is listen-only"
            )
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
            raise ValueError("CANopen nodes have numbers from 1 to 127")
        return nodes


class SessionsSection(Section):
    """Calibration sessions.

    Attributes:
        settle_s: how long the boom must have been still before its fixes count as one standstill.
        fixes_per_shot: how many good fixes are averaged for a control point.
        shot_timeout_s: how long to wait for these fixes.
        control_tolerance_mm: a control point that is off by more than this shows that the set-up has moved.
    """

    settle_s: float = Field(default=1.0, ge=0, le=3600)
    fixes_per_shot: int = Field(default=5, ge=1, le=10_000)
    shot_timeout_s: float = Field(default=60.0, gt=0, le=3600)
    control_tolerance_mm: float = Field(default=5.0, gt=0, le=1000)


class JobsSection(Section):
    """Background jobs.

    Attributes:
        enabled: closed sessions trigger jobs.
        time_limit_s: a job that runs longer is stopped.
        max_attempts: how often a job that is interrupted is started; stops of the daemon do not count as interruptions.
        seed: seed of every random choice in identification and residual training.
    """

    enabled: bool = True
    time_limit_s: float = Field(default=1800.0, gt=0, le=7 * 86_400)
    max_attempts: int = Field(default=3, ge=1)
    seed: int = Field(default=0, ge=0)


class StoreSection(Section):
    """What the store keeps, and its backups. Sessions, their captures, and models are always kept.

    Attributes:
        keep_days: captures and readings outside sessions are deleted after this many days; when absent, they are kept
            while there is space.
        free_gb: the oldest captures and readings outside sessions are deleted while the free space on the disk and in
            the store's free pages together is below this, in GiB, or below a tenth of the disk.
        backup_directory: where a backup is made every day, preferably on a different disk; none are made when absent.
        backups: how many backups are kept.
    """

    keep_days: float | None = Field(default=None, ge=1, le=36_500)
    free_gb: float = Field(default=5.0, gt=0, le=1e6)
    backup_directory: Path | None = None
    backups: int = Field(default=3, ge=1)

    @property
    def free_bytes(self) -> int:
        """Free space that the store should have, in bytes."""
        return round(self.free_gb * 2**30)


class ReportSection(Section):
    """The reports of jobs.

    Attributes:
        tolerance_mm: largest root mean square error on held-out fixes that the machine may have; reports then state
            whether the machine passed. Without it they state that no tolerance is given.
    """

    tolerance_mm: float | None = Field(default=None, gt=0)


class TipCanSection(Section):
    """The live corrected tip on a CAN link: two frames per tip, as docs/reference/tip-frames.md describes.

    Attributes:
        link: name of a [[can]] link that may transmit.
        arbitration_id: 11-bit identifier of the first frame; the second frame has the next identifier. Both must be
            free in CANopen: 680h to 6DFh.
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
            raise ValueError("CANopen leaves 680h to 6DFh free, and two identifiers are needed; give 0x680 to 0x6DE")
        return first


class TipSection(Section):
    """The live corrected tip.

    Attributes:
        prism: prism whose place is given as the tip, unless a command names one.
        rate_hz: how often the tip is sent.
        can: where the tip is sent; nowhere when absent.
    """

    prism: str
    rate_hz: float = Field(default=5.0, gt=0, le=20)
    can: TipCanSection | None = None


class MetricsSection(Section):
    """Metrics for Prometheus, on the loopback interface only.

    Attributes:
        port: port on which they are served, as docs/reference/metrics.md describes; 0 for any free port, which is
            logged.
    """

    port: int = Field(ge=0, le=65535)


class NotifySection(Section):
    """Notices of alarms to people elsewhere: by a webhook, by a command, or by both.

    Attributes:
        webhook_url: address to which each message is sent as JSON by POST; chat services show its key `text`.
        command: a program with its arguments, run without a shell; it gets each message as an e-mail on its standard
            input, as `sendmail ADDRESS` and `msmtp ADDRESS` expect.
        least: lowest severity of alarms that are sent.
    """

    webhook_url: str | None = None
    command: tuple[str, ...] = ()
    least: Literal["warning", "critical"] = "warning"

    @field_validator("webhook_url")
    @classmethod
    def _is_http(cls, url: str | None) -> str | None:
        # An address that no client accepts must be refused here: a later error message would contain its secret.
        try:
            parts = urlsplit(url or "http://none")
            is_good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
            (parts.hostname or "").encode("idna")  # as in the name look-up: a label may be too long, or empty
        except ValueError:
            is_good = False
        is_plain = all("!" <= letter <= "~" for letter in url or "")
        if not is_good or not is_plain or parts.username is not None:
            raise ValueError(
                "give the address of a web server, without user, blanks or non-ASCII characters: https://HOST/PATH"
            )
        return url

    @field_validator("command")
    @classmethod
    def _is_a_program(cls, command: tuple[str, ...]) -> tuple[str, ...]:
        if command and not command[0].startswith("/"):
            raise ValueError("give the program's full path, as in ['/usr/bin/msmtp', 'someone@example.com']")
        return command

    @model_validator(mode="after")
    def _goes_somewhere(self) -> NotifySection:
        if self.webhook_url is None and not self.command:
            raise ValueError("give webhook_url, command, or both; otherwise notices cannot be sent")
        return self


class WebSection(Section):
    """The operator's page, served by `rigcal web`.

    Attributes:
        host: address at which the page is served; any address other than loopback needs a certificate and tokens.
        port: port on which the page is served.
        certificate, key: PEM files for TLS; both or neither.
        names: names by which browsers address this computer, in addition to its host name.
        tokens: token file; `web-tokens.json` in the state directory when absent.
    """

    host: str = "127.0.0.1"
    port: int = Field(default=8370, ge=0, le=65535)
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    tokens: Path | None = None

    def beside(self, base: Path) -> WebSection:
        """Return a copy whose relative paths are resolved against the configuration's directory.

        Args:
            base: directory of the configuration.
        """
        paths = {name: getattr(self, name) for name in ("certificate", "key", "tokens")}
        return self.model_copy(update={name: path and base / path for name, path in paths.items()})
