"""docs/reference/alarms.md: every rule, its meaning and its remedy."""

from __future__ import annotations

from daemon.alarms.alarm import Rule
from daemon.alarms.library import library

_HEAD = """# Alarms

What is wrong, since when, and what to do: `rigcal alarms` shows the active ones, `rigcal alarms --all` those that are
over as well; `rigcal status` begins with them. Each is a line in the log when it is raised (warning or error) and when
it is over (info), and a row of the store's table `alarms`.

A *critical* alarm: data are lost, or cannot be used. A *warning*: measuring goes on, and someone should look.

Alarms are raised and cleared by what is known at the moment, once a second; nobody acknowledges them. One that stands
when rigcal is stopped goes on, with its old time, if its reason is still there 15 s after the next start.

## Notices

Alarms leave the machine where the configuration says how: by a webhook, by a command, or by both.

```toml
[notify]
webhook_url = "https://chat.example.com/hooks/SECRET"
command = ["/usr/bin/msmtp", "someone@example.com"]
least = "critical"   # alarms below it are not told; "warning" when left out
```

Each target is told when an alarm is raised, when it becomes critical and when it is over; an alarm that stands when
`[notify]` is added, too. What happens within 3 s is one message. At most 20 messages an hour are sent; what comes
beyond waits and is told in one. A delivery that fails is tried again after 10 s, then after twice as long each time, at
most 15 min. Notices are rows of the store's table `notices` until they are delivered, so that a restart loses none; one
that waits for more than 7 days is not sent by the next start. `rigcal alarms --send-test` sends a notice that is no
alarm. Nothing is sent when a log is replayed. The address may hold a secret: the configuration should be readable by
root and the service's group alone; log and status name the host only.

The webhook gets a POST of a JSON object: `text` (all of it, as chat services show it), `subject`, `rig`, `host`,
`notices` (`event` raised, cleared or test, `kind`, `subject`, `severity`, `text`, `remedy`, `raised_utc_ns`,
`at_utc_ns`) and `unlisted`, how many older ones there are besides. A status of 2xx is a delivery, a redirection is not.

The command is run without a shell, for at most 30 s, and gets an e-mail without recipients (RFC 5322) on its standard
input. Exit status 0 is a delivery. The service's sandbox has no network until `network.conf` opens it to the address of
the webhook or mail server ([installation](../../deploy/README.md#the-network)). The command runs in it too: programs
that speak SMTP themselves, such as msmtp, work; those that hand over to a local mail system by a set-group-ID program
(Postfix' sendmail) do not.

This page is made from the code: `python -m docs.references`.
"""


def page() -> str:
    """Return the text of docs/reference/alarms.md."""
    sections = (_section(rule) for rule in sorted(library(), key=lambda rule: rule.kind))
    return "\n".join((_HEAD, *sections))


def _section(rule: Rule) -> str:
    return f"## {rule.kind}\n\n*{rule.severity.capitalize()}.* {rule.meaning}\n\n**What to do:** {rule.remedy}\n"
