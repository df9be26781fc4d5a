"""docs/reference/metrics.md: every family of metrics."""

from __future__ import annotations

from daemon.monitoring.metrics import FAMILIES
from docs.references.markdown import table

_HEAD = """# Metrics

rigcal serves its state in [Prometheus' text format](https://prometheus.io/docs/instrumenting/exposition_formats/)
where the configuration has

```toml
[metrics]
port = 9750
```

at `http://127.0.0.1:9750/metrics`. It listens on the loopback interface alone: a collector on the rig's computer
(Prometheus itself, its agent mode, Grafana Alloy, Telegraf) reads it and takes it further. The service has no network
until `network.conf` opens it ([installation](../../deploy/README.md#the-network)). Counters count since the
daemon's start. All of it is in `rigcal status --json` too; besides stand the `process_` metrics of the official Python
client (memory, descriptors, CPU time).

An example of a scrape configuration and of a rule:

```yaml
scrape_configs:
  - job_name: rigcal
    static_configs: [{targets: ["127.0.0.1:9750"]}]
```

```yaml
- alert: RigcalCritical
  expr: rigcal_alarms{severity="critical"} > 0 or rigcal_alarms_looked_age_seconds > 30 or up{job="rigcal"} == 0
```

A monitoring system that runs commands asks `rigcal health`: one line a finding with what to do, and the exit status of
the Nagios plugin interface (0 good, 1 warning, 2 critical, 3 the daemon cannot be asked). A member of `read_group` may
run it.

This page is made from the code: `python -m docs.references`.
"""


def page() -> str:
    """Return the text of docs/reference/metrics.md."""
    rows = ((f"`{f.name}`", f.kind, ", ".join(f"`{label}`" for label in f.labels), f.help) for f in FAMILIES)
    return "\n".join((_HEAD, *table(("metric", "kind", "labels", "meaning"), rows))) + "\n"
