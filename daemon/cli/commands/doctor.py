"""`rigcal doctor`: finds what prevents rigcal from working, and shows remedies."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import click

from daemon.cli import diagnosis
from daemon.cli.client import STATUS_TIMEOUT_S, client_options, socket_of
from daemon.cli.command import DONE, FAILED, Command, Delivered
from daemon.cli.diagnosis import Finding
from daemon.cli.terminal import echo
from daemon.commands import INSTALLED_CONFIG, CommandError
from daemon.control.protocol import request
from daemon.version import VERSION

_COLOURS = {"good": "green", "warning": "yellow", "fault": "red", "unknown": None}


@click.command(cls=Command)
@client_options
def doctor(socket: Path | None, config: Path | None, as_json: bool) -> Delivered:
    """Find what prevents rigcal from working.

    Checks configuration, permissions, interfaces, station, clock, disk, timeouts, daemon and store. Each finding has a
    remedy. Nothing is sent to a bus or an instrument and nothing is changed; the state of devices is taken from a
    running daemon. Without --config, /etc/rigcal/rigcal.toml is read if it exists. The exit status is 1 if there is a
    fault, 0 if there are at most warnings.
    """
    logging.getLogger("can").setLevel(logging.ERROR)
    findings = list(_examine(socket, config))
    has_fault = any(finding.state == "fault" for finding in findings)
    if not as_json:
        _show(findings)
    told = {"is_good": not has_fault, "findings": [finding.as_dict() for finding in findings]}
    return Delivered(told, FAILED if has_fault else DONE)


def _examine(socket: Path | None, path: Path | None) -> Iterator[Finding]:
    config = None
    if path is None and INSTALLED_CONFIG.exists():
        path = INSTALLED_CONFIG
    if path is not None:
        config, finding = diagnosis.read_configuration(path)
        yield finding
    yield from diagnosis.computer(config)
    at = socket_of(socket, None) if config is None or socket is not None else config.socket_path
    try:
        status = request(at, "status", timeout_s=STATUS_TIMEOUT_S)
    except CommandError as error:
        if config is not None:
            yield from diagnosis.devices(config)
        elif path is None:
            remedy = "`rigcal init` writes one; use --config FILE for a different file"
            yield Finding("configuration", "unknown", f"{INSTALLED_CONFIG} does not exist", remedy)
        yield diagnosis.socket_finding(str(error))
        return
    if config is not None:
        # A simulated or replayed rig has the configuration of a real rig but none of its devices.
        for finding in diagnosis.devices(config) if status["mode"] == "live" else ():
            yield _as_the_daemon_has_it(finding, status["acquisition"]["links"])
    yield from diagnosis.daemon_state(status, VERSION)


def _as_the_daemon_has_it(finding: Finding, links: Sequence[dict[str, object]]) -> Finding:
    """Return a finding on a port; a fault becomes good if the daemon has the port open."""
    is_open = any(link["name"] == finding.subject and link["up"] for link in links)
    if finding.state == "fault" and is_open:
        return replace(finding, state="good", text=f"{finding.text}; the daemon has it open", remedy="")
    return finding


def _show(findings: Sequence[Finding]) -> None:
    width = max(len(finding.subject) for finding in findings)
    for finding in findings:
        echo(f"{finding.state:8} {finding.subject:{width}}  {finding.text}", fg=_COLOURS[finding.state])
        if finding.remedy:
            echo(f"{'':8} {'':{width}}  -> {finding.remedy}")
    faults, warnings = (sum(finding.state == state for finding in findings) for state in ("fault", "warning"))
    echo(f"{faults} fault{'s' * (faults != 1)}, {warnings} warning{'s' * (warnings != 1)}", bold=True)
