"""The page over real sockets: what it tells, to whom, what it refuses, and that no client holds up another."""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.config.config import Config
from daemon.store import Store
from daemon.store.reader import Reader
from daemon.web.server import REQUEST_S
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.web.web_support import WebProcess, wait_for

STATE_FRESH_S = 2.0


def written(directory: Path) -> Path:
    """A configuration whose daemon is the idle one."""
    path = directory / "rigcal.toml"
    path.write_text('rig = "swdt82"\nstate_directory = "."\n', encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Config]:
    with idle_daemon(tmp_path_factory.mktemp("rig")) as config:
        written(config.state_directory)
        yield config


@pytest.fixture(scope="module")
def config(daemon: Config) -> Path:
    return daemon.state_directory / "rigcal.toml"


@pytest.fixture(scope="module")
def page(config: Path) -> Iterator[WebProcess]:
    web = WebProcess(config)
    yield web
    assert web.stop() == 0, config.with_name("web.log").read_text()


def rigcal(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "daemon.cli.main", *arguments], capture_output=True, text=True, check=False
    )


def token_of(config: Path, name: str, role: str) -> str:
    made = rigcal("web", "token", "add", name, "--role", role, "--config", str(config), "--json")
    assert made.returncode == 0, made.stderr
    return str(json.loads(made.stdout)["token"])


def self_signed(directory: Path) -> tuple[Path, Path]:
    """A certificate and its key."""
    certificate, key = directory / "page.pem", directory / "page.key"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"),
            *("-days", "2", "-subj", "/CN=rig", "-keyout", str(key), "-out", str(certificate)),
        ],
        check=True,
        capture_output=True,
    )
    return certificate, key


def signed_in(web: WebProcess, token: str) -> str:
    """The cookie of somebody who has signed in."""
    answer = web.post("/api/login", {"token": token})
    assert answer.status == 200, answer.body
    return answer.headers["set-cookie"].partition(";")[0]


# ---- what every answer carries, and what every request must fulfil ---------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/now", "/guide", "/session", "/models", "/health", "/history"])
def test_every_screen_has_an_address_of_its_own(page: WebProcess, path: str) -> None:
    answer = page.get(path)
    assert answer.status == 200
    assert "text/html" in answer.headers["content-type"]
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "server" not in answer.headers


def test_the_page_asks_nothing_of_anyone_else(page: WebProcess) -> None:
    static = Path("daemon/web/static")
    for file in [*static.glob("**/*.html"), *static.glob("css/*.css"), *static.glob("js/**/*.js")]:
        text = file.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in text, file
        assert "https://" not in text, file
        assert "innerHTML" not in text, file
        assert page.get(f"/static/{file.relative_to(static)}").status == 200


def test_a_name_that_is_not_this_computers_is_refused(page: WebProcess) -> None:
    assert page.get("/api/me", Host="evil.example").status == 421
    assert page.get("/api/me", Host=f"localhost:{page.port}").status == 200


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Content_Type": "text/plain"}, 415),
        ({"Content_Type": "application/x-www-form-urlencoded"}, 415),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
    ],
)
def test_a_command_must_come_from_the_page_itself(page: WebProcess, headers: dict[str, str], status: int) -> None:
    answer = page.post("/api/command", {"command": "setup.new", "arguments": {"id": "X"}}, **headers)
    assert answer.status == status
    assert "X" not in {setup["id"] for setup in page.command("setup.list").data["result"]}


def test_another_page_cannot_read_either(page: WebProcess) -> None:
    assert page.get("/api/history", Sec_Fetch_Site="cross-site").status == 403
    assert "access-control-allow-origin" not in page.get("/api/me").headers


@pytest.mark.parametrize("is_chunked", [False, True])
def test_a_request_is_small(page: WebProcess, is_chunked: bool) -> None:
    connection = page.connection()
    body: Any = (b"x" * 8192 for _ in range(20)) if is_chunked else b"x" * 100_000
    headers = {"Origin": page.own_origin, "Content-Type": "application/json"}
    connection.request("POST", "/api/command", body, headers, encode_chunked=is_chunked)
    assert connection.getresponse().status == 413
    connection.close()


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"null", b'{"command": 3}', b"[" * 30_000])
def test_what_is_no_command_is_refused(page: WebProcess, body: bytes) -> None:
    headers = {"Origin": page.own_origin, "Content_Type": "application/json"}
    assert page.send("POST", "/api/command", body, **headers).status == 400


@pytest.mark.parametrize("command", ["devices.configure", "store.prune", "simulation.visit", "nonsense"])
def test_what_a_browser_may_never_do_is_no_command(page: WebProcess, command: str) -> None:
    assert page.command(command).status == 400


# ---- who may do what -------------------------------------------------------------------------------------------------


def test_without_a_token_the_page_lends_the_rights_of_who_started_it(page: WebProcess, daemon: Config) -> None:
    assert page.get("/api/me").data["role"] == "approve"
    assert page.command("setup.new", operator="Ada", id="S1").status == 200
    assert page.command("session.start", operator="Ada", prism="r").status == 200
    assert page.command("session.abort", operator="Ada").status == 200
    with Reader(daemon.store_path) as reader:
        (row,) = reader.rows("SELECT operator FROM calibration_sessions")
    assert row["operator"] == "Ada (page, approve)"


def test_a_refusal_of_the_daemon_reaches_the_page_as_its_sentence(page: WebProcess) -> None:
    answer = page.command("session.stop")
    assert answer.status == 400
    assert "no session is open" in answer.data["error"]
    assert page.command("model.accept", id=99).status == 400


def test_roles_end_where_they_must(config: Path) -> None:
    web = WebProcess(config, "--loopback-role", "read")
    try:
        assert web.get("/api/me").data["role"] == "read"
        assert web.command("status").status == 200
        refused = web.command("setup.new", id="S2")
        assert refused.status == 403
        assert "needs the role operate" in refused.data["error"]
        operator = signed_in(web, token_of(config, "Bo", "operate"))
        approver = signed_in(web, token_of(config, "Cy", "approve"))
        assert web.command("setup.new", cookie=operator, id="S2").status == 200
        refused = web.command("model.accept", cookie=operator, id=1)
        assert (refused.status, "the token of Bo has the role operate" in refused.data["error"]) == (403, True)
        assert web.command("model.accept", cookie=approver, id=1).status == 400, "asked, and there is no such model"
        removed = rigcal("web", "token", "remove", "Bo", "--config", str(config))
        assert removed.returncode == 0, removed.stderr
        assert web.command("setup.new", cookie=operator, id="S3").status == 403
    finally:
        assert web.stop() == 0


def test_who_signs_in_is_kept_with_what_is_done(config: Path, daemon: Config, page: WebProcess) -> None:
    cookie = signed_in(page, token_of(config, "Dee", "operate"))
    assert page.get("/api/me", Cookie=cookie).data | {"local_user": ""} == {
        "name": "Dee",
        "role": "operate",
        "by_token": True,
        "local_user": "",
    }
    page.command("setup.new", id="S9")
    assert page.command("session.start", cookie=cookie, operator="the King", prism="s", setup="S9").status == 200
    page.command("session.abort", cookie=cookie)
    with Reader(daemon.store_path) as reader:
        assert [*reader.rows("SELECT operator FROM calibration_sessions WHERE prism = 's'")] == [
            {"operator": "Dee (page, operate)"}
        ]


def test_other_computers_need_tls_and_a_token(config: Path, tmp_path: Path) -> None:
    refused = rigcal("web", "--config", str(config), "--host", "0.0.0.0")
    assert refused.returncode == 2
    assert "use TLS" in refused.stderr
    certificate, key = self_signed(tmp_path)
    web = WebProcess(config, "--host", "0.0.0.0", "--certificate", str(certificate), "--key", str(key))
    try:
        assert web.get("/api/me").data["role"] is None
        endless = f"/report/{'9' * 4400}"
        for path in ("/api/live", "/api/history", "/api/rig", "/report/1", endless, "/api/sessions/x/fixes"):
            assert web.get(path).status == 401, path
        assert web.command("status").status == 401
        answer = web.post("/api/login", {"token": token_of(config, "Eve", "read")})
        cookie = answer.headers["set-cookie"]
        assert cookie.startswith("__Host-rigcal=")
        assert {"secure", "httponly", "samesite=strict", "path=/"} <= {p.strip().lower() for p in cookie.split(";")}
        assert web.command("status", cookie=cookie.partition(";")[0]).status == 200
    finally:
        assert web.stop() == 0


def test_guessing_tokens_is_slow_and_keeps_nobody_out_who_has_one(config: Path) -> None:
    web = WebProcess(config)
    try:
        token = token_of(config, "Rig 4's tablet", "operate")
        statuses = [web.post("/api/login", {"token": f"rigcal_{number}"}).status for number in range(12)]
        assert statuses == [401] * 10 + [429] * 2
        assert int(web.post("/api/login", {"token": "rigcal_x"}).headers["retry-after"]) > 30
        assert web.post("/api/login", {"token": "rigcal_3"}).status == 401, "tried before, so nothing is guessed"
        assert web.get("/api/me", cookie=signed_in(web, token)).data["name"] == "Rig 4's tablet"
    finally:
        assert web.stop() == 0


def test_an_address_that_is_taken_is_said(config: Path, page: WebProcess) -> None:
    refused = rigcal("web", "--config", str(config), "--port", str(page.port))
    assert refused.returncode == 1
    assert "another program listens there" in refused.stderr


# ---- the live state --------------------------------------------------------------------------------------------------


def test_the_state_comes_five_times_a_second_and_says_what_is_next(page: WebProcess) -> None:
    events = page.events()
    first = wait_for("a state", events, lambda event: event["daemon"] is None)
    assert (first["rig"], first["guide"]) == ("swdt82", None)
    assert first["next"]["button"]
    assert first["time"]["real_s_per_s"] == 1.0
    began = time.monotonic()
    numbers = [next(events)["number"] for _ in range(20)]
    assert numbers == sorted(set(numbers))
    assert time.monotonic() - began < 20 / 5
    events.close()  # type: ignore[attr-defined]


@pytest.mark.long
def test_a_client_that_takes_nothing_holds_up_no_other(page: WebProcess) -> None:
    stalled = socket.create_connection((page.host, page.port))
    stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stalled.sendall(f"GET /api/live HTTP/1.1\r\nHost: localhost:{page.port}\r\n\r\n".encode())
    counts = [0] * 5
    over = threading.Event()

    def listen(number: int) -> None:
        for _ in page.events():
            counts[number] += 1
            if over.is_set():
                return

    clients = [threading.Thread(target=listen, args=(number,)) for number in range(len(counts))]
    for client in clients:
        client.start()
    events = page.events()
    next(events)
    began = time.monotonic()
    for _ in range(30):
        next(events)
    taken_s = time.monotonic() - began
    over.set()
    for client in clients:
        client.join()
    events.close()  # type: ignore[attr-defined]
    stalled.close()
    assert taken_s < 30 / 5
    assert min(counts) >= 25


@pytest.mark.long
@pytest.mark.long
@pytest.mark.parametrize(
    "sent", ["", "GET / HTTP/1.1\r\nHost:", "POST /api/command HTTP/1.1\r\nHost: {}\r\nContent-Length: 9\r\n\r\n{{"]
)
def test_a_connection_on_which_no_whole_request_comes_is_closed(page: WebProcess, sent: str) -> None:
    with socket.create_connection((page.host, page.port), timeout=2 * REQUEST_S + 10.0) as silent:
        silent.sendall(sent.format(f"localhost:{page.port}").encode())
        while silent.recv(4096):
            pass


def test_a_daemon_that_is_gone_is_told_and_comes_back_by_itself(tmp_path: Path) -> None:
    config = written(tmp_path)
    with idle_daemon(tmp_path):
        web = WebProcess(config)
        events = web.events()
        wait_for("a state", events, lambda event: event["daemon"] is None)
    try:
        began = time.monotonic()
        gone = wait_for("the end", events, lambda event: event["daemon"] is not None)
        assert time.monotonic() - began < STATE_FRESH_S
        assert "no daemon is listening" in gone["daemon"]
        assert web.command("status").status == 502
        with idle_daemon(tmp_path):
            back = wait_for("a state", events, lambda event: event["daemon"] is None)
            assert back["rig"] == "swdt82"
    finally:
        assert web.stop() == 0


def test_the_stream_of_a_removed_token_ends(config: Path, tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path)
    web = WebProcess(config, "--host", "0.0.0.0", "--certificate", str(certificate), "--key", str(key))
    try:
        events = web.events(Cookie=signed_in(web, token_of(config, "Fay", "approve")))
        next(events)
        rigcal("web", "token", "remove", "Fay", "--config", str(config))
        for _ in events:
            pass  # until the stream ends by itself
    finally:
        assert web.stop() == 0


# ---- what the store and the rig file hold ----------------------------------------------------------------------------


def test_the_drawing_follows_the_rig_file(page: WebProcess) -> None:
    shape = page.get("/api/rig").data
    assert [joint["name"] for joint in shape["joints"]][:2] == ["theta1", "theta3"]
    assert set(shape["chains"]) == {"w", "b", "r", "s"}


def test_history_and_fixes_of_a_store_that_is_new(page: WebProcess) -> None:
    history = page.get("/api/history").data
    assert (history["drift"], history["misclosures"], history["changes"]) == ([], [], [])
    assert page.get("/api/sessions/none/fixes").status == 404
    assert page.get("/report/7").status == 404
    assert page.get("/static/../app.py").status == 404


def test_no_other_file_is_read_in_place_of_the_daemons_store(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        web = WebProcess(written(tmp_path))
        try:
            Store(tmp_path / "other.sqlite").close()
            (tmp_path / "other.sqlite").replace(config.store_path)
            for path in ("/api/history", "/api/sessions/none/fixes"):
                answer = web.get(path)
                assert (answer.status, "not the store that the daemon writes to" in answer.data["error"]) == (502, True)
        finally:
            assert web.stop() == 0
