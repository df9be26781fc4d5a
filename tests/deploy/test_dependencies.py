"""The audit of locked packages, with pip-audit itself and a server of advisories on this computer."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.dependencies import LOCKS, PYTHONS, audit, pins
from tests.deploy.conftest import REPOSITORY

KNOWN = {
    "id": "PYSEC-2026-1",
    "aliases": ["CVE-2026-0001"],
    "summary": "reads what it should not",
    "modified": "2026-01-01T00:00:00Z",
    "affected": [
        {
            "package": {"name": "idna", "ecosystem": "PyPI"},
            "ranges": [{"type": "ECOSYSTEM", "events": [{"introduced": "0"}, {"fixed": "3.21"}]}],
            "versions": ["3.20"],
        }
    ],
}


class Advisories(BaseHTTPRequestHandler):
    """Answers as https://api.osv.dev/v1/query does: one package has an advisory."""

    def do_POST(self) -> None:
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        found = [KNOWN] if asked["package"]["name"] == "idna" else []
        answer = json.dumps({"vulns": found} if found else {}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def advisories() -> Iterator[tuple[str, ...]]:
    """Options of pip-audit that ask a server of this computer."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Advisories) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"http://127.0.0.1:{server.server_port}/v1/query"
        yield ("--vulnerability-service", "osv", "--osv-url", url)
        server.shutdown()
        thread.join()


def test_a_known_vulnerability_is_named_with_the_version_that_mends_it(advisories: tuple[str, ...]) -> None:
    found = list(audit({"idna==3.20", "h11==0.16.0"}, *advisories))
    assert found == [("idna==3.20", "PYSEC-2026-1, CVE-2026-0001; mended in 3.21")]


def test_packages_without_advisories_are_clean(advisories: tuple[str, ...]) -> None:
    assert list(audit({"h11==0.16.0"}, *advisories)) == []


def test_advisories_that_cannot_be_reached_are_told_from_a_fault() -> None:
    closed = ("--vulnerability-service", "osv", "--osv-url", "http://127.0.0.1:9/v1/query")
    with pytest.raises(ConnectionError):
        list(audit({"h11==0.16.0"}, *closed))
    with pytest.raises(RuntimeError):
        list(audit({"h11==0.16.0"}, "--no-such-option"))


@pytest.mark.parametrize("python", PYTHONS)
def test_each_python_is_audited_with_its_own_pins(python: str) -> None:
    rig, all_packages = (pins(REPOSITORY / lock, python) for lock in LOCKS)
    assert rig - {p for p in rig if p.startswith("setuptools==")} <= all_packages
    names = [pin.partition("==")[0] for pin in all_packages]
    assert len(names) == len({*names}), "one version of each"
    assert {"numpy", "pip-audit"} <= {*names}
