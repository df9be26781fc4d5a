"""Rig, configuration, observations, exported session: texts that people edit."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

from calibration.errors import DataError, RigError
from calibration.observations import parse_observations
from calibration.rig.description import parse_rig
from daemon.acquisition.channel_files import ChannelFiles
from daemon.acquisition.channels import decoder_factories, node_setups
from daemon.cli.offline import with_columns
from daemon.config.config import ConfigError, parse_config
from daemon.rig_files import load_rig
from daemon.sessions.export.session_file import read_session_file
from drivers.can_decoder import CanDecoder
from drivers.errors import DescriptionError
from simulators.plan import read_plan
from tests.fuzz.streams import frames, pack_frames
from tests.fuzz.target import Run, Target, check_refusal, scratch_directory
from tests.fuzz.targets.logs import on_file

_TOML = (
    *(
        b"[[joint]]\n",
        b"[[row]]\n",
        b"[[prism]]\n",
        b"[[mass]]\n",
        b"[[channel]]\n",
        b"[[signal]]\n",
        b"[station]\n",
        b'name = "theta1"\n',
    ),
    *(
        b"a.b.c.d = 1\n",
        b"{ d = { L3 = 1.0 } }",
        b"after = 0\n",
        b"frame = 9\n",
        b"'''",
        b'"""',
        b"1979-05-27",
        b"true",
    ),
    *(b"9" * 30, b"9" * 4400, b"1_000", b"0x7fffffffffffffff", b"= " + b"[" * 2000, b"= " + b"{a=" * 500, b"a." * 3000),
    *(b'device = "raw"\n', b"arbitration_id = 0x1A0\n", b"zero_counts = 9223372036854775807\n", b"scale = 1e308\n"),
)
_CSV = (
    b"prism",
    b"x_mm",
    b"sigma_x_mm",
    b"setup",
    b"pose",
    b"time_s",
    b"q1_deg",
    b"q1_dir",
    b",",
    b'"',
    b'""',
    b"\n,\n",
)


_SECTIONS = (
    *(b"[[can]]\n", b"[[station]]\n", b"[tip]\n", b"[jobs]\n", b"[store]\n", b"[metrics]\n", b"[notify]\n"),
    *(b'webhook_url = "http://[::1"\n', b'command = ["/bin/cat"]\n', b'least = "critical"\n', b"keep_days = -1\n"),
)


def _rig() -> Run:
    directory = load_rig("swdt82").directory
    some = list(
        frames(b"".join(bytes([0x40]) + i.to_bytes(4, "little") + b"\x08" + bytes(range(8)) for i in (0x1A0, 0x201)))
    )

    def run(data: bytes) -> None:
        with suppress(UnicodeDecodeError):
            text = data.decode()
            try:
                rig = parse_rig(text, "rig.toml")
                files = ChannelFiles.read(rig, directory)
                for link in {channel.link for channel in rig.channels}:
                    node_setups(rig, files, link)
                    decoder = CanDecoder(link, [make() for make in decoder_factories(rig, files, link)])
                    for capture in some:
                        decoder.feed(capture)
                        decoder.tick(capture.stamp)
            except (RigError, DescriptionError) as error:
                check_refusal(error)

    assert len(pack_frames(some)) > 0
    return run


def _config() -> Run:
    def run(data: bytes) -> None:
        with suppress(UnicodeDecodeError):
            try:
                parse_config(data.decode(), Path("/etc/rigcal.toml"))
            except ConfigError as error:
                for line in str(error).splitlines():
                    assert len(line) < 1000, line[:300]

    return run


def _observations() -> Run:
    rig = load_rig("ur10").rig

    def run(data: bytes) -> None:
        for positions_required in (True, False):
            try:
                found = parse_observations(data, rig, "data.csv", positions_required=positions_required)
            except DataError as error:
                check_refusal(error)
            else:
                found.groups()
                with_columns(data, {"x_pred_mm": found.position_mm[:, 0]})

    return run


def _plan() -> Run:
    path, rig = scratch_directory() / "plan.csv", load_rig("swdt82").rig

    def run(data: bytes) -> None:
        path.write_bytes(data)
        try:
            stops = read_plan(path, rig, 2.0)
        except ValueError as error:
            check_refusal(error, str(path))
        else:
            for pose, stand_s in stops:
                assert all(map(math.isfinite, (*pose.values(), stand_s)))

    return run


def _session(path: Path) -> None:
    read_session_file(path)


TARGETS = [
    Target("rig", _rig, "text", _TOML, is_slow=True),
    Target("config", _config, "text", (*_TOML, *_SECTIONS), is_slow=True),
    Target("plan", _plan, "text", (*_CSV, b"theta1_deg", b"L2_mm", b"theta1_dir", b"dwell_s", b"nan"), is_slow=True),
    Target("observations", _observations, "text", _CSV, is_slow=True),
    Target("session-file", lambda: on_file(".json", _session), "json", is_slow=True),
]
