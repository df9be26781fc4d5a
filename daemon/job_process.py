"""What a job does, in a process of its own: reads the store, computes, writes files, tells its parent.

Standard input carries the order, one JSON object, and then stays open: when it closes, the daemon is gone and so goes
the job. Standard output carries what `daemon.order` describes. Only the daemon writes to the store.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, ModelError
from calibration.model import CalibratedModel
from calibration.observations import Observations, parse_observations
from calibration.rig import Rig
from daemon.checkpoint import FileCheckpoint
from daemon.files import write_file
from daemon.modelfiles import REPORT, read_model, write_model
from daemon.numba_cache import prepare
from daemon.order import Order
from daemon.session_data import sessions_csv, setup_lines
from daemon.store.errors import StoreError
from daemon.store.reader import Reader

Progress = Callable[[float, str], None]


def main() -> int:
    """Entry of the process: exit status 0 when a result was told, 1 when an error was, 2 when the daemon was gone."""
    line = sys.stdin.readline()
    if not line:
        return 2  # the daemon was gone before it could say what to do
    order = Order.from_line(line)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    tell = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # a library that prints must not break the protocol

    def say(message: dict[str, Any]) -> None:
        tell.write(json.dumps(message) + "\n")
        tell.flush()

    try:
        result = perform(order, lambda share, text: say({"progress": share, "message": text}))
    except Exception as error:  # noqa: BLE001 - whatever goes wrong becomes the job's result
        if isinstance(error, CalibrationError | StoreError):
            say({"error": str(error)})
        else:
            sys.excepthook(type(error), error, error.__traceback__)
            say({"error": f"{type(error).__name__}: {error}; the daemon's log has the whole story"})
        return 1
    say({"result": result})
    return 0


def perform(order: Order, progress: Progress) -> dict[str, Any]:
    """Carry out an order with the functions that the offline commands use.

    Returns:
        What the store keeps: `model` (its directory), `manifest_sha256`, `stage`, `metrics`, `sessions`; for a
        report `report` (the file) and `evaluation` (the contract's object); for a comparison `comparison`.

    Raises:
        CalibrationError: in a sentence, what is wrong with data or result.
    """
    prepare()
    work = {
        "identification": _identify,
        "residual": _train_residual,
        "report": _report,
        "comparison": _compare,
    }[order.kind]
    return work(order, progress)


def _identify(order: Order, progress: Progress) -> dict[str, Any]:
    from calibration import pipeline
    from calibration.rig import parse_rig

    text = _rig_text(order)
    rig = parse_rig(text, "the sessions' rig")
    observations = _observations(order, rig, order.session_ids)
    # The job keeps its number when it runs again, so it goes on where the daemon was killed.
    with FileCheckpoint(Path(order.models_directory) / f"{order.job_id:05d}.checkpoint") as checkpoint:
        model = pipeline.identify(rig, text, observations, seed=order.seed, progress=progress, checkpoint=checkpoint)
        stage = "effects" if model.effects else "geometric"
        return _write(order, model, stage, observations, order.session_ids)


def _train_residual(order: Order, progress: Progress) -> dict[str, Any]:
    from calibration import pipeline

    model = read_model(Path(str(order.model)), order.model_sha256)
    observations = _observations(order, model.rig, order.train_ids)
    model = pipeline.train_residual(model, observations, seed=order.seed, progress=progress)
    return _write(order, model, "hybrid", observations, order.train_ids)


def _report(order: Order, progress: Progress) -> dict[str, Any]:
    from calibration import pipeline
    from daemon.report import build_report
    from daemon.report.from_model import report_input

    progress(0.0, "evaluating")
    directory = Path(str(order.model))
    model = read_model(directory, order.model_sha256)
    training = pipeline.evaluate(model, _observations(order, model.rig, order.train_ids))
    held_out = None
    if order.session_ids:
        checks = _observations(order, model.rig, order.session_ids)
        known = bool(np.isin(checks.setup, training.observations.setup).all())
        held_out = pipeline.evaluate(model, checks, refit_base=not known)
    progress(0.3, "drawing")
    with Reader(Path(order.store)) as reader:
        setups = setup_lines(reader, (*order.train_ids, *order.session_ids))
    page = build_report(report_input(training, held_out, setups=setups))
    path = directory / REPORT
    write_file(path, page.encode())
    judged = held_out or training
    return {
        "report": str(path),
        "model": order.model,
        "sessions": list(order.train_ids),
        "held_out": held_out is not None,
        "evaluation": judged.as_dict(0.0),
    }


def _compare(order: Order, progress: Progress) -> dict[str, Any]:
    """The candidate beside the live model, on sessions that neither was trained on."""
    result: dict[str, Any] = {"model": order.model, "sessions": list(order.train_ids)}
    about = {
        "manifest_sha256": order.model_sha256,
        "live": order.live_id,
        "live_manifest_sha256": order.live_sha256,
        "sessions": list(order.session_ids),
    }
    if not order.session_ids:
        sentence = "no check session holds fixes that neither model was trained on; nothing can be compared yet"
        return result | {"comparison": about | {"is_better": False, "sentence": sentence}}
    from calibration.promotion import compare_held_out

    progress(0.0, "comparing with the live model")
    candidate = read_model(Path(str(order.model)), order.model_sha256)
    live, note = None, ""
    if order.live_model is not None:
        try:
            live = read_model(Path(order.live_model), order.live_sha256)
        except ModelError as error:
            # What cannot be used any more must not keep a good model from its place; the operator sees why.
            note = f"the live model cannot be read ({error}); "
    compared = compare_held_out(candidate, live, _observations(order, candidate.rig, order.session_ids)).as_dict()
    return result | {"comparison": about | compared | {"sentence": f"{note}{compared['sentence']}"}}


def _rig_text(order: Order) -> str:
    """The rig file of the newest session: the sessions carry what they were recorded with."""
    with Reader(Path(order.store)) as reader:
        rows = reader.rows("SELECT rig_text FROM calibration_sessions WHERE id = ?", (order.session_ids[-1],))
        return str(next(iter(rows))["rig_text"])


def _observations(order: Order, rig: Rig, session_ids: tuple[str, ...]) -> Observations:
    with Reader(Path(order.store)) as reader:
        data = sessions_csv(reader, rig, session_ids)
    return parse_observations(data, rig, f"sessions {', '.join(session_ids)}")


def _write(
    order: Order, model: CalibratedModel, stage: str, observations: Observations, session_ids: tuple[str, ...]
) -> dict[str, Any]:
    from calibration import pipeline

    directory = Path(order.models_directory) / f"{order.job_id:05d}-{stage}"
    sha256 = write_model(directory, model)
    evaluation = pipeline.evaluate(model, observations)
    return {
        "model": str(directory),
        "manifest_sha256": sha256,
        "stage": stage,
        "sessions": list(session_ids),
        "metrics": {"training": evaluation.stages(), "noise_mm": model.noise_mm},
    }


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(2)


if __name__ == "__main__":
    sys.exit(main())
