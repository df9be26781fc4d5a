"""docs/reference/alarms.md: every alarm rule with its meaning and remedy."""

from __future__ import annotations

from daemon.alarms.alarm import Rule
from daemon.alarms.library import library

_HEAD = """# Alarms

An alarm reports what is wrong, since when, and what to do. `rigcal alarms` shows the active alarms, and
`rigcal alarms --all` also those that have ended; `rigcal status` begins with the active ones. Each alarm is logged when
it is raised (warning or error) and when it ends (info), and is a row of the store's table `alarms`.

A *critical* alarm means that data are lost or cannot be used. A *warning* means that measuring continues, and someone
should check the rig.

Alarms are raised and cleared once a second from the present state; nobody acknowledges them. An alarm that is active
when rigcal is stopped continues, with its original time, if its cause is still there 15 s after the next start.

## Notices

rigcal sends notices of alarms if they are configured: by a webhook, by a command, or by both.

```toml
[notify]
webhook_url = "https://chat.example.com/hooks/SECRET"
command = ["/usr/bin/msmtp", "someone@example.com"]
least = "critical"   # least severity that is sent; default "warning"
```

Each target receives a notice when an alarm is raised, becomes critical or ends, and also for each alarm that is active
when `[notify]` is added. Notices within 3 s are combined into one message. At most 20 messages an hour are sent;
further notices wait and are sent in one message. A failed delivery is retried after 10 s, then with the delay doubled
each time, up to 15 min. Notices are rows of the store's table `notices` until they are delivered, so a restart loses
none. They are also sent while the store cannot be written; a restart may then repeat one. The next start does not send
a notice that has waited for more than 7 days. `rigcal alarms --send-test` sends a test notice. Nothing is sent when a
log is replayed. The address may contain a secret, so only root and the service's group should be able to read the
configuration; log and status show only the host.

The webhook receives a POST request with a JSON object: `text` (the whole message, as chat services show it),
`subject`, `rig`, `host`, `notices` (`event` raised, cleared or test, `kind`, `subject`, `severity`, `text`, `remedy`,
`raised_utc_ns`, `at_utc_ns`) and `unlisted`, the number of older notices that are not in the list. A status of 2xx
means delivered; a redirection is a failure.

The command is run without a shell, for at most 30 s, and receives an e-mail without recipients (RFC 5322) on its
standard input. Exit status 0 means delivered. The service's sandbox has no network until `network.conf` opens it to the
address of the webhook or mail server ([installation](../../deploy/README.md#the-network)). The command runs in the same
sandbox. Programs that use SMTP themselves, such as msmtp, work; those that pass mail to a local mail system through a
set-group-ID program (Postfix' sendmail) do not.

This page is generated from the code: `python -m docs.references`.
"""


def page() -> str:
    """Return the text of docs/reference/alarms.md."""
    sections = (_section(rule) for rule in sorted(library(), key=lambda rule: rule.kind))
    return "\n".join((_HEAD, *sections))


def _section(rule: Rule) -> str:
    return f"## {rule.kind}\n\n*{rule.severity.capitalize()}.* {rule.meaning}\n\n**What to do:** {rule.remedy}\n"
