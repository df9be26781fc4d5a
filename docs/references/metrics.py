"""docs/reference/metrics.md: every metric family."""

from __future__ import annotations

from daemon.monitoring.metrics import FAMILIES
from docs.references.markdown import table

_HEAD = """# Metrics

rigcal serves its state in [Prometheus' text format](https://prometheus.io/docs/instrumenting/exposition_formats/)
if the configuration contains

```toml
[metrics]
port = 9750
```

The address is `http://127.0.0.1:9750/metrics`. rigcal listens only on the loopback interface: a collector on the rig's
computer (Prometheus itself, its agent mode, Grafana Alloy, Telegraf) reads the metrics and forwards them. The service
has no network until `network.conf` opens it ([installation](../../deploy/README.md#the-network)). Counters start at the
daemon's start. `rigcal status --json` contains the same data. The `process_` metrics of the official Python client
(memory, descriptors, CPU time) are served as well.

Examples of a scrape configuration and of an alerting rule:

```yaml
scrape_configs:
  - job_name: rigcal
    static_configs: [{targets: ["127.0.0.1:9750"]}]
```

```yaml
- alert: RigcalCritical
  expr: rigcal_alarms{severity="critical"} > 0 or rigcal_alarms_looked_age_seconds > 30 or up{job="rigcal"} == 0
```

A monitoring system that runs commands can use `rigcal health`. It prints one line for each finding, with what to do,
and has the exit status of the Nagios plugin interface (0 good, 1 warning, 2 critical, 3 the daemon does not answer).
Members of `read_group` may run it.

This page is generated from the code: `python -m docs.references`.
"""


def page() -> str:
    """Return the text of docs/reference/metrics.md."""
    rows = ((f"`{f.name}`", f.kind, ", ".join(f"`{label}`" for label in f.labels), f.help) for f in FAMILIES)
    return "\n".join((_HEAD, *table(("metric", "kind", "labels", "meaning"), rows))) + "\n"
