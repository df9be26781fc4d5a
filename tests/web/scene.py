"""A rig's store as it is after months: live and waiting models, check shots that drift, control points, jobs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from daemon.config.config import Config
from daemon.store.queries.setups import SetupTable
from drivers.clock import NS_PER_S
from tests.daemon.support.idle_daemon import idle_daemon
from tests.daemon.support.models import ModelRig

DAY_S = 86_400.0
STAGES = (("nominal", 9.1), ("geometric", 1.9), ("effects", 1.3), ("hybrid", 1.2))


def fill(directory: Path) -> None:
    """Make the store: model 1 was replaced by model 2, which drifts; model 3 waits, and is better."""
    rig = ModelRig(directory)
    try:
        rig.jobs.measured("s001-r", 8, prisms=["r"])
        for _ in range(2):
            rig.accepted()
        live = rig.models.live()
        run = rig.models.live_run()
        assert live is not None
        assert run is not None
        setups = SetupTable(rig.store, "swdt82")
        setups.put_control_point("S1", "cp1", {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0})
        for number in range(6):
            rig.clock.advance(9 * DAY_S)
            name = f"check{number}"
            rig.jobs.session(name, "check")
            at = {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0, "fix_ids_json": []}
            about = {"session_id": name, "phase": "start", "misclosure_mm": 0.4 + 0.3 * number}
            setups.add_shot("S1", "cp1", rig.clock.now(), **at, **about)
            rig.models.add_drift_check(
                **{"live_since": run.since, "session_id": name, "fixes": 20, "standstills": 4, "reason": ""},
                **{"ratio": 0.9 + 0.2 * number, "upper": 0.8 * number, "lower": 0.0, "alarm": "none"},
            )
        candidate = rig.models.get(rig.candidate())
        comparison = {
            **{"live": live.id, "live_manifest_sha256": live.manifest_sha256, "is_better": True},
            **{"manifest_sha256": candidate.manifest_sha256, "sessions": ["check4", "check5"], "against": "live"},
            **{"before_mm": 2.31, "after_mm": 1.22, "p": 0.003, "fixes": 40, "standstills": 8},
            "sentence": "on 40 held-out fixes of 8 standstills its error is 1.22 mm RMS, compared with 2.31 mm of the "
            "live model (a gain by chance: p = 0.003): better beyond chance",
        }
        rig.models.note_comparison(str(candidate.path), comparison)
        training = [{"stage": stage, "rms_mm": mm, "mean_mm": mm, "max_mm": mm, "std_mm": mm} for stage, mm in STAGES]
        for model in rig.models.all():
            metrics = dict(model.metrics) | {"training": training, "noise_mm": 1.0}
            rig.store.update("models", {"id": model.id}, {"metrics_json": metrics})
        with rig.store.transaction():
            row = {"kind": "gap", "session_id": "s001-r", "through_session_id": "s001-r", "state": "failed"}
            row |= {"error": "too few poses: 3 of 20"}
            rig.store.insert("jobs", row | rig.store.instant(rig.clock.now().shifted(NS_PER_S), "created_"))
    finally:
        rig.close()


@contextlib.contextmanager
def served(directory: Path) -> Iterator[Config]:
    """A daemon on that store."""
    fill(directory)
    (directory / "rigcal.toml").write_text('rig = "swdt82"\nstate_directory = "."\n', encoding="utf-8")
    with idle_daemon(directory) as config:
        yield config
