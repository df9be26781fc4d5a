"""The next version of the package over this one, with the data of this one."""

from __future__ import annotations

import json
import shutil

from tests.vm.service import BUS, Service, expect


def an_upgrade_keeps_the_data(service: Service) -> str:
    """An upgrade makes a verified backup, keeps store and models, and starts the service again."""
    service.on("cards")
    shutil.copy(service.machine.image.next_package, service.machine.shared / "next.deb")
    live, stored = service.ask("status")["models"]["live"], service.stored()
    sessions = len(service.ask("session.list"))
    was = service.machine.run("dpkg-query -W -f '${Version}' rigcal")
    began_s = service.machine.now_s()
    said = service.machine.run("DEBIAN_FRONTEND=noninteractive apt-get install -y /host/next.deb 2>&1", 3600.0)
    version = service.machine.run("dpkg-query -W -f '${Version}' rigcal")
    expect(version == f"{was}.next" and "failed" not in said and "Traceback" not in said, said)
    service.wait_until_well(600.0)
    took_s = service.first_capture_s(began_s + 60.0, BUS) - began_s
    found = service.ask("status")
    expect(found["models"]["live"] == live, f"the live model was {live} and is {found['models']['live']}")
    expect(len(service.ask("session.list")) == sessions, "sessions are missing")
    expect(service.stored() >= stored, "captures are missing")
    backups = service.machine.run("cat /var/lib/rigcal/before-upgrade/rigcal-*/backup.json")
    expect(json.loads(backups), said)
    return f"{stored} frames, {sessions} sessions and the live model kept, backup made, service back in {took_s:.0f} s"
