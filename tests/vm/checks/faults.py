"""What befalls a computer: clocks, sleep, load, a full disk, and processes that hang or die."""

from __future__ import annotations

import time
from functools import partial

from tests.vm.checks.links import RECOVERY_S, recovered
from tests.vm.service import STATION, Service, expect

STEP_S = 3600
ASLEEP_S = 10
SPIN_S = 30
HELD_S = 8
WATCHDOG_S = 30  # of the unit
FULL = "/var/lib/full.img"


def a_clock_that_was_set_is_noticed(service: Service) -> str:
    """A clock that is set forward and back by an hour is stored with its size, and nothing stops."""
    service.on("cards")
    since_s = service.machine.now_s()
    for step_s in (STEP_S, -STEP_S):
        service.machine.run(f"date -s '@'$(($(date +%s) + {step_s}))")
        sql = f"""SELECT code FROM device_events WHERE kind = 'clock_step' AND code * {step_s} > 0
            AND monotonic_ns > {round(since_s * 1e9)}"""
        found = service.wait("the event", partial(service.query, sql))
        expect(abs(found[-1][0] / 1e3 - step_s) < 2.0, f"a step of {step_s} s is stored as {found} ms")
    alarm = service.wait_for_alarm("clock_stepped")
    expect(alarm["remedy"], alarm)
    return f"+-{STEP_S} s stored; {recovered(service, service.machine.now_s())}"


def a_suspended_computer_goes_on(service: Service) -> str:
    """A computer that sleeps has a monotonic clock that stands; awake, it reads on, and the pause is told as a step.

    The whole machine stands still; awake, its clock is set on by as much, as the kernel does.
    """
    service.on("cards")
    before_s = service.machine.now_s()
    with service.machine.held():
        time.sleep(ASLEEP_S)
    awake = service.machine.tried(f"date -s '{ASLEEP_S} seconds'")
    expect(awake.began_s - before_s < ASLEEP_S / 2, "the machine's monotonic clock has gone on")
    figure = f"{recovered(service, awake.ended_s)}, station {recovered(service, awake.ended_s, STATION)}"
    sql = f"SELECT code FROM device_events WHERE kind = 'clock_step' AND monotonic_ns > {round(before_s * 1e9)}"
    found = service.wait("the step", lambda: service.query(sql))
    expect(abs(found[-1][0] / 1e3 - ASLEEP_S) < 2.0, f"a pause of {ASLEEP_S} s is stored as {found} ms")
    return f"asleep {ASLEEP_S} s, told as {found[-1][0] / 1e3:.1f} s; {figure}"


def two_spinning_processes_cost_no_frame(service: Service) -> str:
    """Two processes that would take both processors, at a higher priority than the service, cost no frame."""
    service.on("cards")
    before, counted = service.pause_rig(), service.counted("can0")
    service.resume_rig()
    spin = "systemd-run -q --collect --unit=spin-{} -p Nice=-5 -p RuntimeMaxSec={} sh -c 'while :; do :; done'"
    for name in "ab":
        service.machine.run(spin.format(name, SPIN_S))
    service.wait(
        "the two to end", lambda: service.machine.tried("systemctl is-active spin-a spin-b").status != 0, 600.0
    )
    stored, sent = service.pause_rig() - before, service.counted("can0") - counted
    service.resume_rig()
    dropped = service.link()["dropped"]
    expect(stored == sent > 0 and dropped == 0, f"{sent} frames came in, {stored} are stored, {dropped} dropped")
    return f"0 of {sent} frames lost in {SPIN_S} s"


def a_process_that_was_held_up_catches_up(service: Service) -> str:
    """A service that is stopped for some seconds and goes on has lost nothing: the kernel has kept it."""
    service.on("cards")
    before, counted = service.pause_rig(), service.counted("can0")
    service.resume_rig()
    pid = service.property("MainPID")
    gone_on = service.machine.tried(f"kill -STOP {pid}; sleep {HELD_S}; kill -CONT {pid}")
    figure = recovered(service, gone_on.ended_s)
    stored, sent = service.pause_rig() - before, service.counted("can0") - counted
    service.resume_rig()
    expect(stored == sent > 0, f"{sent} frames came in, {stored} are stored")
    return f"0 of {sent} frames lost, {figure}"


def a_hung_service_is_restarted_by_its_watchdog(service: Service) -> str:
    """A service that hangs is ended by systemd after its watchdog's time, and started again."""
    service.on("cards")
    restarts = int(service.property("NRestarts"))
    pid = service.property("MainPID")
    stopped_s = service.machine.tried(f"kill -STOP {pid}").ended_s
    service.wait("systemd to start it again", lambda: int(service.property("NRestarts")) > restarts, 300.0)
    back_s = service.first_capture_s(stopped_s + 1.0)
    expect(service.property("MainPID") != pid, "it is the same process")
    service.wait_until_well()
    return f"read again {back_s - stopped_s:.0f} s after it hung, of which the watchdog takes {WATCHDOG_S} s"


def a_killed_service_is_restarted(service: Service) -> str:
    """A service that is killed is started again, has all that was committed, and checks its store."""
    service.on("cards")
    before = service.stored()
    killed_s = service.machine.tried(f"kill -KILL {service.property('MainPID')}").ended_s
    expect(service.stored() >= before, "what was stored before is gone")
    back_s = service.first_capture_s(killed_s + 0.5)
    service.wait_until_well()
    health = service.wait("the store's check", lambda: (service.status() or {})["store_health"]["state"] == "ok")
    expect(health, "the store is not well")
    service.wait_for_alarm("link_down", stands=False)
    return f"read again {back_s - killed_s:.1f} s after the kill, of which systemd waits 5 s"


def a_full_disk_is_told_and_nothing_is_lost(service: Service) -> str:
    """A disk without room is an alarm; what comes meanwhile waits, and is stored when there is room."""
    service.on("vcan")
    service.pause_rig()
    service.machine.run(f"truncate -s 200M {FULL} && mke2fs -q -m 0 {FULL} && systemctl stop rigcal")
    service.machine.run(f"mount -o loop {FULL} /var/lib/rigcal && chown rigcal:rigcal /var/lib/rigcal", 120.0)
    try:
        service.machine.run("systemctl start rigcal", 900.0)
        counted = service.counted("vcan0")
        service.resume_rig()
        service.wait_until_well()
        service.machine.tried("dd if=/dev/zero of=/var/lib/rigcal/filler bs=64k 2>/dev/null; sync")
        alarm = service.wait_for_alarm("not_storing", within_s=300.0)
        expect(alarm["remedy"], alarm)
        held = service.stored()
        freed_s = service.machine.tried("rm /var/lib/rigcal/filler").ended_s
        service.wait("the store to grow", lambda: service.stored() > held, pause_s=0.05)
        after_s = service.machine.now_s() - freed_s
        expect(after_s <= RECOVERY_S, f"it stored again {after_s:.2f} s after there was room")
        service.wait_for_alarm("not_storing", stands=False)
        stored, sent = service.pause_rig(), service.counted("vcan0") - counted
        expect(stored == sent, f"{sent} frames came in, {stored} are stored")
    finally:
        service.stop_rig()
        service.machine.run("systemctl stop rigcal; umount /var/lib/rigcal; systemctl start rigcal", 900.0)
    return f"0 of {sent} frames lost, stored again {after_s:.2f} s after there was room"
