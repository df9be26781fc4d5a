"""docs/reference/configuration.md: every key of the daemon's configuration."""

from __future__ import annotations

from pydantic import BaseModel

from daemon.config.config import Config
from daemon.config.sections import (
    CanSection,
    JobsSection,
    MetricsSection,
    NotifySection,
    ReportSection,
    SessionsSection,
    StoreSection,
    TipCanSection,
    TipSection,
    WebSection,
)
from docs.references.rig_keys import keys
from drivers.stations.config import StationConfig
from drivers.stations.serial_port import SerialConfig

_HEAD = """# Configuration

Every key of the configuration file, which is `/etc/rigcal/rigcal.toml` for the installed service. The format is TOML.
Unknown keys are errors. Relative paths of files and directories are relative to the file's directory; ports and
interfaces are used as they are written. `rigcal config check FILE` checks the file without opening a device,
`rigcal init` writes an initial file, and [Connect bus and station](../how-to/connect.md) explains it step by step.

This page is generated from the code: `python -m docs.references`.
"""
_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("The file", Config),
    ("`[[can]]`", CanSection),
    ("`[[station]]`", StationConfig),
    ("`serial` of a `[[station]]`", SerialConfig),
    ("`[sessions]`", SessionsSection),
    ("`[jobs]`", JobsSection),
    ("`[store]`", StoreSection),
    ("`[report]`", ReportSection),
    ("`[tip]`", TipSection),
    ("`[tip.can]`", TipCanSection),
    ("`[metrics]`", MetricsSection),
    ("`[notify]`", NotifySection),
    ("`[web]`", WebSection),
)


def page() -> str:
    """Return the text of docs/reference/configuration.md."""
    sections = {title.strip("`[]") for title, _ in _TABLES}
    own = {name: field for name, field in Config.model_fields.items() if name not in sections}
    lines = [_HEAD]
    for title, model in _TABLES:
        lines += [f"## {title}", "", *keys(model, own if model is Config else model.model_fields)]
    return "\n".join(lines).rstrip() + "\n"
