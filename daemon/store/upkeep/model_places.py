"""Places of models: their directories lie in the state directory, which may be moved, copied or restored elsewhere."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path

from daemon.store.store import Store

log = logging.getLogger(__name__)

_OF_JOB = re.compile(r"\d{5,}-[a-z]+")  # directory that a job has made, such as 00002-hybrid


def place_of_model(path: str) -> Path | None:
    """Return a model's place below the directory of all models; None if no job has made it.

    Args:
        path: path of the model's directory, such as `/var/lib/rigcal/models/00001-gap/model`.
    """
    parts = Path(path).parts
    at = [number for number, part in enumerate(parts) if _OF_JOB.fullmatch(part)]
    return Path(*parts[at[-1] :]) if at else None


def follow_moved_models(store: Store, models: Path) -> None:
    """Correct the stored paths of models that now lie in a different directory of models.

    Args:
        store: the store, open for writing.
        models: the directory of all models.

    Raises:
        sqlite3.Error: the store cannot be read or written.
    """
    for row in list(store.rows("SELECT DISTINCT path FROM models")):
        place = place_of_model(row["path"])
        if place is None or Path(row["path"]) == models / place or not (models / place).is_dir():
            continue
        earlier = Path(row["path"]).parents[len(place.parts) - 1]  # the directory of all models
        before, now = (json.dumps(str(own / place.parts[0]))[1:-1] for own in (earlier, models))
        with store.transaction() as db:
            db.execute("UPDATE models SET path = ? WHERE path = ?", [str(models / place), row["path"]])
            db.execute("UPDATE jobs SET result_json = replace(result_json, ?, ?)", [before, now])
        log.warning("the model in %s is now in %s", row["path"], models / place)
