"""A whole calibration, as operators do it, and a computer that is shut down while its jobs run."""

from __future__ import annotations

from typing import Any

from tests.vm.image import OPERATOR
from tests.vm.service import Service, expect

TRAINING_POSES, CHECK_POSES = 14, 5
SESSION_S, JOBS_S = 600.0, 3600.0
LIST_UNITS = "systemctl list-units --plain --no-legend"
SHUTDOWN = "like-shutdown.target"
POLL_S = 5.0  # each question costs the machine


def a_session_ends_in_an_accepted_model(service: Service) -> str:
    """Set-up, control points, poses of the plan, stop; the jobs with a shutdown during the first; a model accepted."""
    service.on("cards")
    service.ask("setup.new", id="vm", instrument="simulated Topcon GTS-800A", tilt_arcsec=3.0, ppm=0.0)
    _hold(service, "static_poses", TRAINING_POSES)
    _hold(service, "check", CHECK_POSES)
    _shut_down_during_a_job(service)
    before = service.link()
    began_s = service.machine.now_s()
    service.wait("the jobs", lambda: _have_ended(service), JOBS_S, POLL_S)
    took_s = service.machine.now_s() - began_s
    jobs = service.ask("jobs.list")
    expect(all(job["state"] == "done" for job in jobs), [(j["kind"], j["state"], j["error"]) for j in jobs])
    after = service.link()
    expect(after["dropped"] == before["dropped"] == 0, f"frames were dropped while jobs ran: {after}")
    candidate = service.ask("status")["models"]["candidate"]
    expect(candidate is not None and candidate["is_acceptable"], candidate)
    accepted = service.command_line(OPERATOR, "model", "accept", str(candidate["id"]))
    expect(accepted.status == 0, accepted.output)
    live = service.ask("status")["models"]["live"]
    expect(live is not None and live["id"] == candidate["id"], live)
    sentence = candidate["comparison"]["sentence"].partition(":")[0]
    return f"{len(jobs)} jobs in {took_s:.0f} s; {sentence}"


def _hold(service: Service, kind: str, poses: int) -> None:
    """Hold a session: a control point first and last, poses in between."""
    session = service.ask("session.start", prism="tip", kind=kind, operator=OPERATOR)["id"]
    _shoot(service)

    def recorded() -> int:
        if service.ask("status")["session"]["prism_suspicions"]:  # it was far away when the station was back
            service.ask("session.confirm-prism", operator=OPERATOR)
        return int(service.ask("session.show", id=session)["poses"])

    before = recorded()
    service.wait(f"{poses} poses", lambda: recorded() - before >= poses, SESSION_S, POLL_S)
    _shoot(service)
    closed = service.ask("session.stop")
    expect(closed["not_used"] is None, closed)


def _shoot(service: Service) -> None:
    service.aim("cp1")
    service.machine.run("sleep 1.5")  # until the last fix of the prism has come
    service.ask("session.shoot", point="cp1")
    service.aim("tip")


def _shut_down_during_a_job(service: Service) -> None:
    """End the service, its jobs and their slice in one transaction, as systemd does when the computer is shut down.

    The job is no attempt then, and is queued again by itself.
    """

    def running() -> dict[str, Any] | None:
        return next((job for job in service.ask("jobs.list") if job["state"] == "running"), None)

    machine = service.machine
    job = service.wait("a job that runs", running, JOBS_S)
    unit = service.wait("its unit", lambda: machine.run(f"{LIST_UNITS} 'rigcal-jobs@*.service'").partition(" ")[0])
    ended = f"rigcal.service rigcal-jobs.socket system-rigcaljobs.slice {unit}"
    machine.write(f"/run/systemd/system/{SHUTDOWN}", f"[Unit]\nConflicts={ended}\nAfter={ended}\n")
    machine.run(f"systemctl daemon-reload && systemctl start {SHUTDOWN}", 120.0)
    found = service.query(f"SELECT state, error, attempts FROM jobs WHERE id = {job['id']}")
    expect(found == [["interrupted", "the daemon was stopped", 0]], f"{job}, then {found}")
    machine.run(f"systemctl stop {SHUTDOWN}; systemctl start rigcal-jobs.socket rigcal", 900.0)
    service.wait_until_well()


def _have_ended(service: Service) -> bool:
    jobs = service.ask("jobs.list")
    kinds = {job["kind"] for job in jobs if job["state"] not in ("queued", "running")}
    return {"gap", "residual", "report", "comparison"} <= kinds or any(job["state"] == "failed" for job in jobs)
