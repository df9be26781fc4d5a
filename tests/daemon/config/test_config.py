import contextlib
import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from daemon.commands import INSTALLED_CONFIG
from daemon.config.config import Config, ConfigError, parse_config, read_config
from daemon.config.sections import (
    CanSection,
    JobsSection,
    NotifySection,
    SessionsSection,
    StoreSection,
    TipCanSection,
    TipSection,
    WebSection,
)
from drivers.stations.config import StationConfig
from drivers.stations.serial_port import SerialConfig

GOOD = """
rig = "swdt82"
state_directory = "state"

[[can]]
channel = "can0"

[[station]]
serial.path = "/dev/rigcal-station"
"""


def check(text: str, tmp_path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, tmp_path / "rigcal.toml")
    return str(caught.value)


def test_a_minimal_configuration_listens_only(tmp_path: Path) -> None:
    config = parse_config(GOOD, tmp_path / "rigcal.toml")
    assert not config.can[0].allow_transmit
    assert config.can[0].interface == "socketcan"
    assert config.station[0].profile == "topcon_gts8"


def test_relative_paths_start_at_the_file(tmp_path: Path) -> None:
    config = parse_config(GOOD.replace("swdt82", "rigs/mine.toml"), tmp_path / "rigcal.toml")
    assert config.store_path == tmp_path / "state" / "rigcal.sqlite"
    assert config.rig == str(tmp_path / "rigs/mine.toml")


def test_whoever_reads_the_installed_configuration_looks_where_the_service_listens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert parse_config(GOOD, INSTALLED_CONFIG).socket_path == Path("/run/rigcal/control.sock")
    assert parse_config(GOOD, tmp_path / "rigcal.toml").socket_path == tmp_path / "state" / "control.sock"
    assert parse_config(f'socket = "own"\n{GOOD}', INSTALLED_CONFIG).socket_path == INSTALLED_CONFIG.with_name("own")
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/of-the-service")  # by systemd, for the service itself
    assert parse_config(GOOD, INSTALLED_CONFIG).socket_path == Path("/run/of-the-service/control.sock")


def test_no_tolerance_is_assumed_and_a_stated_one_is_positive(tmp_path: Path) -> None:
    assert parse_config(GOOD, tmp_path / "rigcal.toml").report.tolerance_mm is None
    stated = parse_config(f"{GOOD}\n[report]\ntolerance_mm = 7.5\n", tmp_path / "rigcal.toml")
    assert stated.report.tolerance_mm == 7.5
    assert "report.tolerance_mm" in check(f"{GOOD}\n[report]\ntolerance_mm = 0\n", tmp_path)


def test_an_unknown_key_is_named_with_what_is_allowed(tmp_path: Path) -> None:
    message = check(GOOD.replace("channel =", "bitrat = 250000\nchannel ="), tmp_path)
    assert "rigcal.toml: can.1.bitrat: unknown key; allowed here: allow_transmit, bitrate" in message


def test_keys_of_nested_sections_are_told_too(tmp_path: Path) -> None:
    message = check(GOOD.replace("serial.path", "serial.bauds = 9600\nserial.path"), tmp_path)
    assert "station.1.serial.bauds: unknown key; allowed here: baud, bytesize, parity, path, stopbits" in message


def test_every_wrong_key_is_told_at_once(tmp_path: Path) -> None:
    message = check('rig = 3\n[[can]]\nchannel = "c"\ninterface = "serial"\n', tmp_path)
    assert len(message.splitlines()) == 2
    assert "rig: " in message
    assert "'socketcan', 'virtual', 'udp_multicast', 'slcan' or 'playback', found 'serial'" in message


@pytest.mark.parametrize("channel", ["/dev/ttyACM0", "", "..", "can 0", "a-name-longer-than-15"])
def test_a_socketcan_channel_that_no_interface_can_have_is_refused(tmp_path: Path, channel: str) -> None:
    message = check(f'rig = "swdt82"\n[[can]]\nchannel = "{channel}"\n', tmp_path)
    assert "is not the name of a network interface" in message
    assert "slcan" in message


@pytest.mark.parametrize(
    "text",
    [
        *(
            "[store]\nkeep_days = 1e300",
            "[store]\nfree_gb = 1e300",
            "[jobs]\nseed = -5",
            "[jobs]\ntime_limit_s = 1e300",
        ),
        *("[sessions]\nsettle_s = 1e300", "[sessions]\nshot_timeout_s = 1e300", "[sessions]\nfixes_per_shot = 1000000"),
    ],
)
def test_a_number_that_no_clock_disk_or_generator_takes_is_refused(tmp_path: Path, text: str) -> None:
    key = text.split()[1]
    assert f".{key}: must be" in check(f'rig = "swdt82"\n{text}\n', tmp_path)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[store]\nfree_gb = true", "store.free_gb: cannot be true or false, found true"),
        ("[sessions]\nfixes_per_shot = false", "sessions.fixes_per_shot: cannot be true or false, found false"),
        ('[store]\nbackup_directory = ""', "store.backup_directory: is empty; give a path, or remove the key"),
        ('state_directory = ""', "state_directory: is empty; give a path, or remove the key"),
        ('[[station]]\nserial.path = "/dev/x"\nmax_range_m = true', "max_range_m: cannot be true or false, found true"),
        ('[[station]]\nserial = { path = "/dev/x", baud = true }', "serial.baud: cannot be true or false, found true"),
    ],
)
def test_neither_is_true_a_number_nor_an_empty_text_a_directory(tmp_path: Path, text: str, told: str) -> None:
    assert told in check(f'rig = "swdt82"\n{text}\n', tmp_path)


def test_a_value_that_an_error_names_is_not_repeated(tmp_path: Path) -> None:
    assert check(f'{GOOD}profile = "leica"\n', tmp_path).endswith("topcon_gts8")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('can = "x"', "can: must be tables, each below a header [[can]], found 'x'"),
        ("can = [5]", "can.1: must be a table, with its keys below a header in square brackets or in braces, found 5"),
        ("tip = 5", "tip: must be a table, with its keys below a header in square brackets or in braces, found 5"),
        ("read_group = 5", "read_group: must be a text in quotes, found 5"),
        ("read_group = 2026-01-02", "read_group: must be a text in quotes, found 2026-01-02"),
        ("read_group = {}", "read_group: must be a text in quotes"),
        ('read_group = ""', "read_group: must not be empty, found ''"),
        ("socket = 5", "socket: must be a path, a text in quotes, found 5"),
        ("jobs.seed = 1.5", "jobs.seed: must be a whole number, found 1.5"),
        ('jobs.enabled = "perhaps"', "jobs.enabled: must be true or false, found 'perhaps'"),
        ("tip.prism = [1]", "tip.prism: must be a text in quotes, found a list"),
        ("store.free_gb = nan", "store.free_gb: must be a finite number, found nan"),
        ("store.free_gb = 0", "store.free_gb: must be above 0, found 0"),
        ("store.backups = 0", "store.backups: must be 1 or more, found 0"),
        ("web.names = 5", "web.names: must be a list, in square brackets, found 5"),
    ],
)
def test_what_a_value_must_be_is_said_in_words_of_toml(tmp_path: Path, text: str, told: str) -> None:
    assert f"rigcal.toml: {told}" in check(f'rig = "swdt82"\n{text}\n', tmp_path).splitlines()[0]


VALUES = ("5", "-5", "1.5", "1e300", "nan", "true", '"x"', '""', "[]", "[[1]]", "{a = 1}", "[{a = 1}]", "2026-01-02")
WORDS_OF_PYTHON = re.compile(
    r"\b(input|valid|tuple|dict\w*|instance|string|integer|parse|True|False|None|datetime|validation)\b"
)


@pytest.mark.parametrize(
    ("section", "model"),
    [
        *(("", Config), ("[[can]]", CanSection), ("[[station]]", StationConfig), ("[station.serial]", SerialConfig)),
        *(("[sessions]", SessionsSection), ("[jobs]", JobsSection), ("[store]", StoreSection)),
        *(("[tip.can]", TipCanSection), ("[tip]", TipSection), ("[web]", WebSection), ("[notify]", NotifySection)),
    ],
)
def test_no_message_speaks_of_python(tmp_path: Path, section: str, model: type[BaseModel]) -> None:
    """Every key with values of every kind."""
    told = []
    for key in model.model_fields:
        for value in VALUES:
            with contextlib.suppress(ConfigError):
                parse_config(f"{section}\n{key} = {value}\n", tmp_path / "rigcal.toml")
                continue
            told.append(check(f"{section}\n{key} = {value}\n", tmp_path))
    assert len(told) > len(model.model_fields)
    assert [message for message in told if WORDS_OF_PYTHON.search(message)] == []


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ('channel = "239.74.163.9"', "channel is a key of the link: set it in the link itself, not in `options`"),
        ('interface = "slcan"', "interface is a key of the link"),
        ("bitrate = 500000", "bitrate is a key of the link"),
        ("allow_transmit = true", "allow_transmit is a key of the link"),
        ("listen_only = false", "listen_only cannot be given as an option: `allow_transmit` sets it; remove it"),
        ('bustype = "slcan"', "bustype cannot be given as an option: `interface` sets it; remove it"),
        (
            "ignore_config = false",
            "ignore_config cannot be given as an option: rigcal does not read python-can's configuration files",
        ),
        ('config_context = "x"', "config_context cannot be given as an option"),
        ("port = [1]", "port must be a string in quotes, a number, true or false"),
    ],
)
def test_an_option_does_not_repeat_what_has_a_key_of_its_own(tmp_path: Path, options: str, told: str) -> None:
    message = check(GOOD.replace('channel = "can0"', f'channel = "can0"\noptions = {{ {options} }}'), tmp_path)
    assert f"rigcal.toml: can.1.options: {told}" in message


@pytest.mark.parametrize(
    "url", ["http://user:SECRET@host/x", "http://host/SECRET x", "http://host:99999/", "ftp://host"]
)
def test_an_address_that_no_client_takes_is_no_webhook(tmp_path: Path, url: str) -> None:
    told = check(f'rig = "swdt82"\n[notify]\nwebhook_url = "{url}"\n', tmp_path)
    assert "give the address of a web server" in told
    assert "SECRET" not in told


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    assert "rig: missing; it is required" in check('state_directory = "x"', tmp_path)


def test_sending_without_saying_so_is_refused(tmp_path: Path) -> None:
    message = check(GOOD.replace('channel = "can0"', 'channel = "can0"\nsync_period_ms = 50'), tmp_path)
    assert "need allow_transmit = true" in message


def test_nodes_outside_canopen_are_refused(tmp_path: Path) -> None:
    message = check(
        GOOD.replace('channel = "can0"', 'channel = "can0"\nallow_transmit = true\ntransmit_nodes = [128]'), tmp_path
    )
    assert "CANopen nodes have numbers from 1 to 127" in message


def test_two_links_of_one_name_are_refused(tmp_path: Path) -> None:
    assert "two links are called 'boom'" in check(GOOD + '[[can]]\nchannel = "can1"\n', tmp_path)


def test_broken_toml_names_the_line(tmp_path: Path) -> None:
    assert "line 2" in check('rig = "swdt82"\n[[can]\n', tmp_path)


def test_a_socket_path_too_long_for_the_kernel_is_refused(tmp_path: Path) -> None:
    assert "unix socket" in check(f'socket = "/{"x" * 120}"\n' + GOOD, tmp_path)


def test_a_missing_file_and_a_binary_file_are_sentences(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_config(tmp_path / "none.toml")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"rig = \xff")
    with pytest.raises(ConfigError, match="not UTF-8"):
        read_config(binary)


def test_what_is_wrong_with_a_whole_table_is_told_without_the_table(tmp_path: Path) -> None:
    text = 'rig = "swdt82"\n[[station]]\nnew_target_after_s = 20\nserial.path = "/dev/x"\n'
    with pytest.raises(ConfigError) as raised:
        parse_config(text, tmp_path / "rigcal.toml")
    assert "station.1: new_target_after_s no longer exists, remove it" in str(raised.value)
    assert "found" not in str(raised.value)


def test_a_second_station_is_refused() -> None:
    text = 'rig = "swdt82"\n' + "".join(
        f'[[station]]\nname = "{name}"\nserial.path = "/dev/{name}"\n' for name in ("one", "two")
    )
    with pytest.raises(ConfigError, match=r"sessions use one station: keep one \[\[station\]\]"):
        parse_config(text, Path("rigcal.toml"))


def test_a_port_belongs_to_one_link() -> None:
    text = 'rig = "swdt82"\n' + "".join(
        f'[[can]]\nname = "{name}"\ninterface = "socketcan"\nchannel = "can0"\n' for name in ("boom", "base")
    )
    with pytest.raises(ConfigError, match=r"two links use 'can0'"):
        parse_config(text, Path("rigcal.toml"))


@pytest.mark.parametrize(("can", "station"), [("ttyUSB0", "by-id"), ("ttyUSB0@115200", "ttyUSB0")])
def test_a_port_is_one_whatever_it_is_called_and_with_its_rate(tmp_path: Path, can: str, station: str) -> None:
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    text = f'''rig = "swdt82"
[[can]]
interface = "slcan"
channel = "{tmp_path}/{can}"
[[station]]
serial.path = "{tmp_path}/{station}"
'''
    with pytest.raises(ConfigError, match=r"two links use '.*ttyUSB0'"):
        parse_config(text, Path("rigcal.toml"))


@pytest.mark.parametrize("channel", ["/dev/ttyUSB0@fast", "/dev/a@b@115200", "/dev/ttyUSB0@", "/dev/"])
def test_a_serial_port_of_can_that_could_not_be_opened_is_refused(channel: str) -> None:
    text = f'rig = "swdt82"\n[[can]]\ninterface = "slcan"\nchannel = "{channel}"\n'
    with pytest.raises(
        ConfigError, match="is not a valid serial port; write its path, optionally followed by @ and its baud rate"
    ):
        parse_config(text, Path("rigcal.toml"))
