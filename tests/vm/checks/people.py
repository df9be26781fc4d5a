"""The service beside people: its start, who may do what, what the journal says."""

from __future__ import annotations

import json

from tests.vm.image import LOOKER, OPERATOR, OTHER
from tests.vm.service import Service, expect

REFUSED = 3


def the_service_starts(service: Service) -> str:
    """The unit is enabled and started as deploy/README.md says, and reports that it is ready."""
    service.machine.run("systemctl enable --now rigcal", 900.0)
    expect(service.property("ActiveState") == "active", service.machine.run("systemctl status rigcal"))
    began, ready = (int(service.property(name)) / 1e6 for name in ("ExecMainStartTimestampMonotonic", _ACTIVE))
    cpu_s = int(service.property("CPUUsageNSec")) / 1e9
    return f"ready after {ready - began:.1f} s, {cpu_s:.1f} s of them at work"


_ACTIVE = "ActiveEnterTimestampMonotonic"


def operators_lookers_and_others_have_their_rights(service: Service) -> str:
    """A member of rigcal does all, one of rigcal-read looks, others are turned away and told what to do."""
    service.on("cards")
    done = service.command_line(OPERATOR, "setup", "new", "rights", "--instrument", "simulated")
    expect(done.status == 0, done.output)
    seen = service.command_line(LOOKER, "status", "--json")
    expect(seen.status == 0, seen.output)
    status = json.loads(seen.output)
    expect(status["rig"] == "loader" and status["acquisition"]["links"], seen.output)
    changed = service.command_line(LOOKER, "setup", "new", "mine")
    expect(changed.status == REFUSED, f"a looker's command ended with {changed.status}: {changed.output}")
    turned_away = service.command_line(OTHER, "status")
    expect(turned_away.status == REFUSED and "rigcal" in turned_away.output, turned_away.output)
    return f"`rigcal status` takes {seen.ended_s - seen.began_s:.1f} s"


def what_reads_its_configuration_finds_the_service(service: Service) -> str:
    """Doctor, the commands on the store and the page are told by the installed configuration where the service is."""
    service.on("cards")
    examined = service.command_line(OPERATOR, "doctor", "--json")
    about = {finding["subject"]: finding for finding in json.loads(examined.output)["findings"]}
    expect(about["daemon"]["state"] == "good", about["daemon"])
    pruned = service.command_line(OPERATOR, "store", "prune", "--days", "3000", "--json")
    expect(pruned.status == 0, pruned.output)
    service.machine.run("systemctl start rigcal-web", 900.0)

    def first_state() -> str:
        return service.machine.tried(f"python3 -I -c '{_PAGE}'").output.strip()

    try:
        live = service.wait("the page", first_state)
        expect("acquisition" in json.loads(live), live)
    finally:
        service.machine.run("systemctl stop rigcal-web")
    return f"doctor has {len(about)} findings; the page shows what it measures"


# The first state that the page is sent; nothing while it is not served yet.
_PAGE = """
import urllib.request
try:
    with urllib.request.urlopen("http://127.0.0.1:8370/api/live", timeout=100) as events:
        print(next(line[6:].decode() for line in events if line.startswith(b"data: ")))
except OSError:
    pass
"""


def the_journal_has_priorities(service: Service) -> str:
    """Warnings can be told from the rest of what the service says."""
    service.on("cards")
    lines = service.machine.run("journalctl -b -u rigcal -o json --output-fields=PRIORITY,MESSAGE").splitlines()
    said = [(int(line["PRIORITY"]), str(line["MESSAGE"])) for line in map(json.loads, lines)]
    count = {priority: sum(p == priority for p, _ in said) for priority in sorted({p for p, _ in said})}
    for text, priority in (("acquiring rig", 6), ("connection to the bus lost", 4)):
        found = {p for p, message in said if text in message}
        expect(priority in found, f"{text!r} has priorities {found}, and not {priority}: {count}")
    expect(not any(message.startswith("<") for _, message in said), "a prefix of priorities is left in a message")
    return ", ".join(f"{n} of priority {priority}" for priority, n in count.items())
