"""The process of a job: reads the store, computes, writes files, and reports to the daemon.

Standard input carries the order, one JSON object, and then stays open: when it closes, the daemon is gone and the job
ends. Standard output carries the messages that `daemon.jobs.order` describes, standard error carries log lines with
their priorities. Only the daemon writes to the store.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, DataError, ModelError, UnsafeError
from calibration.evaluation.drift import check
from calibration.evaluation.evaluation import evaluate
from calibration.evaluation.latency import Latency, estimate_latency
from calibration.evaluation.promotion import compare_held_out
from calibration.identification.samples import averaged
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import train_residual
from calibration.pipeline.find_gap import find_gap
from calibration.rig.description import Rig, parse_rig
from calibration.run_settings import Progress, Run
from daemon.host.safe_output import write_file
from daemon.host.systemd import set_up_logging
from daemon.jobs.checkpoint import FileCheckpoint
from daemon.jobs.order import Order
from daemon.models.gap_files import MODEL, gap_answer, write_gap
from daemon.models.model_files import REPORT, read_model, write_model
from daemon.report.calibration.from_model import provenance, report_input
from daemon.report.calibration.page import calibration_report
from daemon.report.front import Facts
from daemon.report.gap.page import gap_report
from daemon.report.gap.words import gap_headline
from daemon.sessions.session_data import sessions_csv, sessions_measured, setup_lines
from daemon.store.errors import StoreError
from daemon.store.files import FileIdentity
from daemon.store.queries.observations import stations_of
from daemon.store.queries.sessions import session
from daemon.store.reader import Reader
from daemon.warm_up import prepare
from drivers.clock import NS_PER_S, SystemClock

log = logging.getLogger(__name__)

_COMPUTED = 0.9  # progress of a job when its model is computed but not yet written
_LEAST_FIXES = 4  # three fixes determine a base and nothing else


def main() -> int:
    """Run the process; the exit status is 0 after a result, 1 after an error, 2 if the daemon has gone."""
    line = sys.stdin.readline()
    if not line:
        return 2  # the daemon ended before it sent the order
    set_up_logging(is_prefixed=True)  # the daemon logs what it reads from standard error
    order = Order.from_line(line)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    tell = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output that a library prints must not break the protocol

    def say(message: dict[str, Any]) -> None:
        tell.write(json.dumps(message) + "\n")
        tell.flush()

    say({"pid": os.getpid()})
    try:
        result = perform(order, lambda share, text: say({"progress": share, "message": text}))
    except Exception as error:
        if isinstance(error, CalibrationError | StoreError):
            say({"error": str(error)})
        else:
            log.error("%s failed", order.kind, exc_info=error)
            say({"error": f"{type(error).__name__}: {error}; see the daemon's log for details"})
        return 1
    say({"result": result})
    return 0


def perform(order: Order, progress: Progress) -> dict[str, Any]:
    """Carry out an order with the functions that the offline commands use.

    Args:
        order: the work.
        progress: called with the share of the work that is done and the current step.

    Returns:
        The result that the store keeps. For a new model: `model` (its directory), `manifest_sha256`, `stage`,
        `metrics`, `sessions`, and after the gap workflow also `gap` (the object of `rigcal gap`), `sentence` and
        `report` (the file). For a report: `report` (the file), `evaluation` (the object of `rigcal evaluate`) and
        `latency` (session -> latency of its fixes). For a comparison: `comparison`. For drift: `drift`.

    Raises:
        CalibrationError: data or result cannot be used; the message is one sentence.
    """
    prepare()
    work = {
        "gap": _find_gap,
        "residual": _train_residual,
        "report": _report,
        "comparison": _compare,
        "drift": _check_drift,
    }[order.kind]
    return work(order, progress)


def _find_gap(order: Order, progress: Progress) -> dict[str, Any]:
    """Identify the kinematics and the effects that the simulation lacks; judge the model on the held-out checks."""
    clock = SystemClock()
    started_ns = clock.monotonic_ns()
    text = _rig_text(order)
    rig = parse_rig(text, "the sessions' rig")
    observations = _placing(rig, _observations(order, rig, order.session_ids))
    held_out = _held_out(order, rig, observations)
    models = Path(order.models_directory)
    # The job keeps its number when it runs again, so it resumes where the daemon was killed.
    with FileCheckpoint(models / f"{order.job_id:05d}.checkpoint") as checkpoint:
        found = find_gap(
            rig,
            text,
            observations,
            holdout=held_out,
            run=Run(order.seed, progress=progress, checkpoint=checkpoint).part(0.0, _COMPUTED),
        )
        progress(_COMPUTED, "drawing the report and writing the model")
        directory = models / f"{order.job_id:05d}-gap"
        answer = gap_answer(found, (clock.monotonic_ns() - started_ns) / NS_PER_S)
        checks = ", ".join(np.unique(held_out.session).tolist()) if held_out else "none"
        sources = {"sessions": ", ".join(order.session_ids), "held-out sessions": checks}
        facts = _facts(order, found.model, (*order.session_ids, *order.held_out_ids), directory.name)
        sha256 = write_gap(directory, found, answer, gap_report(found, provenance(found.model, None, sources), facts))
    made = _made(directory / MODEL, sha256, found.model, "effects" if found.effects else "geometric", observations)
    return made | {
        "sessions": list(order.session_ids),
        "gap": found.as_dict(),
        "sentence": gap_headline(found),
        "report": str(directory / REPORT),
    }


def _placing(rig: Rig, observations: Observations) -> Observations:
    """Return the rows at set-ups with enough fixes to determine the base and something of the machine.

    Checks may have few fixes, and so may a session that an operator accepted. Repeats of a pose count once. If no
    set-up has enough, return all rows: the calibration then reports the error.
    """
    chain = Chain(rig, {setup: Placement.identity() for setup in np.unique(observations.setup).tolist()})
    _, different = np.unique(averaged(chain, observations).of_row, return_index=True)
    setups, fixes = np.unique(observations.setup[different], return_counts=True)
    placed = fixes >= _LEAST_FIXES
    if placed.all() or not placed.any():
        return observations
    for setup in setups[~placed]:
        log.warning("set-up %s is skipped: it has fewer than %d fixes in different poses", setup, _LEAST_FIXES)
    return observations.select(np.isin(observations.setup, setups[placed]))


def _held_out(order: Order, rig: Rig, training: Observations) -> Observations | None:
    """Return the check sessions' rows at set-ups of the training data; None if there are none."""
    if not order.held_out_ids:
        return None
    try:
        checks = _observations(order, rig, order.held_out_ids)
    except DataError as error:
        log.warning("the check sessions cannot be used to judge the model: %s", error)
        return None
    return checks.select(np.isin(checks.setup, training.setup)) or None


def _trained_on(order: Order, model: CalibratedModel) -> Observations:
    """Return the training rows of a model: those at the set-ups whose base it includes."""
    observations = _observations(order, model.rig, order.train_ids)
    return observations.select(np.isin(observations.setup, list(model.placements)))


def _train_residual(order: Order, progress: Progress) -> dict[str, Any]:
    model = read_model(Path(str(order.model)), order.model_sha256)
    observations = _trained_on(order, model)
    model = train_residual(model, observations, run=Run(order.seed, progress=progress).part(0.0, _COMPUTED))
    progress(_COMPUTED, "writing the model")
    directory = Path(order.models_directory) / f"{order.job_id:05d}-hybrid"
    made = _made(directory, write_model(directory, model), model, "hybrid", observations)
    return made | {"sessions": list(order.train_ids)}


def _report(order: Order, progress: Progress) -> dict[str, Any]:
    progress(0.0, "evaluating the model on the check sessions")
    directory = Path(str(order.model))
    model = read_model(directory, order.model_sha256)
    training = evaluate(model, _trained_on(order, model))
    held_out = None
    if order.session_ids:
        checks = _observations(order, model.rig, order.session_ids)
        known = bool(np.isin(checks.setup, training.observations.setup).all())
        held_out = evaluate(model, checks, refit_base=not known)
    progress(0.3, "drawing the report")
    session_ids = (*order.train_ids, *order.session_ids)
    with _store(order) as reader:
        setups = setup_lines(reader, session_ids)
        stations = {name: " and ".join(stations_of(reader, name)) for name in session_ids}
    facts = _facts(order, model, session_ids, directory.name)
    latencies = _latencies(order, model)
    page = calibration_report(
        report_input(training, held_out, setups=setups, facts=facts, latencies=latencies, stations=stations)
    )
    path = directory / REPORT
    write_file(path, page.encode())
    judged = held_out or training
    return {
        "report": str(path),
        "model": order.model,
        "sessions": list(order.train_ids),
        "held_out": held_out is not None,
        "evaluation": judged.as_dict(0.0),
        "latency": {
            name: asdict(found) if isinstance(found, Latency) else {"reason": found}
            for name, found in latencies.items()
        },
    }


def _latencies(order: Order, model: CalibratedModel) -> dict[str, Latency | str]:
    """Return session -> latency of its fixes relative to the joint readings, or the reason why it is unknown."""
    found: dict[str, Latency | str] = {}
    for name in (*order.train_ids, *order.session_ids):
        try:
            with _store(order) as reader:
                data = sessions_csv(reader, model.rig, (name,), moving=True)
            found[name] = estimate_latency(model, parse_observations(data, model.rig, f"fixes of {name} on the move"))
        except CalibrationError as error:
            found[name] = str(error)
    return found


def _compare(order: Order, progress: Progress) -> dict[str, Any]:
    """Compare the candidate with the live model on sessions that neither was trained on."""
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
    progress(0.0, "comparing with the live model")
    candidate = read_model(Path(str(order.model)), order.model_sha256)
    live, note = None, ""
    is_unreadable = False
    if order.live_model is not None:
        try:
            live = read_model(Path(order.live_model), order.live_sha256)
        except ModelError as error:
            # An unusable live model must not keep a good candidate from replacing it; the operator sees the reason.
            note, is_unreadable = f"the live model cannot be read ({error}); ", True
    if live is not None and (why := candidate.rig.misreading(live.rig)):
        live, note = None, f"the live model has a different rig file ({why}), so it does not fit these readings; "
    compared = compare_held_out(candidate, live, _observations(order, candidate.rig, order.session_ids)).as_dict()
    told = {"sentence": f"{note}{compared['sentence']}", "live_was_unreadable": is_unreadable}
    return result | {"comparison": about | compared | told}


def _check_drift(order: Order, progress: Progress) -> dict[str, Any]:
    """Evaluate the live model on each of the check sessions that it was not trained on."""
    checks: list[dict[str, Any]] = []
    if order.session_ids:
        live = read_model(Path(str(order.live_model)), order.live_sha256)
        for done, name in enumerate(order.session_ids):
            progress(done / len(order.session_ids), f"comparing check session {name} with the live model")
            try:
                found = check(live, _observations(order, live.rig, (name,)))
            except (DataError, UnsafeError) as error:
                nothing = {"fixes": 0, "scores": [], "ratio": None, "reason": str(error)}
                checks.append({"session": name, **nothing})
                continue
            fitted = (
                f"the base at set-up {', '.join(found.refitted)} was fitted on these fixes" if found.refitted else ""
            )
            about = {"fixes": found.fixes, "scores": list(found.scores), "ratio": found.ratio, "reason": fitted}
            checks.append({"session": name, **about})
    return {"drift": {"live": order.live_id, "live_since": order.live_since, "checks": checks}}


def _facts(order: Order, model: CalibratedModel, session_ids: Sequence[str], name: str) -> Facts:
    """Return the head of a report: who measured what, when and with which devices, according to the store."""
    with _store(order) as reader:
        measured = sessions_measured(reader, session_ids)
    return Facts(
        rig=model.rig.name,
        model=name,
        made_utc_ns=SystemClock().now().utc_ns,
        tolerance_mm=order.tolerance_mm,
        **asdict(measured),
    )


def _store(order: Order) -> Reader:
    return Reader(Path(order.store), FileIdentity(*order.store_file) if order.store_file else None)


def _rig_text(order: Order) -> str:
    """Return the rig file of the newest session; each session stores the rig file that it was recorded with.

    Raises:
        DataError: none of the sessions can be used any more.
    """
    if not order.session_ids:
        raise DataError(
            "sessions", "none that the job was queued for can be used any more; `rigcal session list` shows why"
        )
    with _store(order) as reader:
        newest = session(reader, order.session_ids[-1])
        assert newest is not None  # no session is ever deleted
        return str(newest["rig_text"])


def _observations(order: Order, rig: Rig, session_ids: tuple[str, ...]) -> Observations:
    with _store(order) as reader:
        data = sessions_csv(reader, rig, session_ids)
    # Nobody knows the lines of this table, so messages name fixes by pose and session.
    return replace(parse_observations(data, rig, f"sessions {', '.join(session_ids)}"), place="pose")


def _made(
    directory: Path, sha256: str, model: CalibratedModel, stage: str, observations: Observations
) -> dict[str, Any]:
    """Return the result that the store keeps of a model that was trained on these observations."""
    evaluation = evaluate(model, observations)
    return {
        "model": str(directory),
        "manifest_sha256": sha256,
        "stage": stage,
        "metrics": {
            "training": evaluation.stages(),
            "noise_mm": model.noise_mm,
            "effects": [effect.as_dict() for effect in model.effects],
        },
    }


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(2)


if __name__ == "__main__":
    sys.exit(main())
