"""The calibration report: one HTML file with the result at the top and the details for engineers below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.rig.description import BEYOND_BUILDING
from daemon.report import drawing, markup
from daemon.report.calibration import figures
from daemon.report.calibration.inputs import STAGES, USUAL, ErrorTable, ReportInput, SetupLine, Stage
from daemon.report.calibration.timing import timing
from daemon.report.front import Accuracy, Facts, Verdict, front, judge, signatures
from daemon.report.plain_names import coefficient_words, constant_words, in_words, joint_words, unit_words
from daemon.report.words import DASH, INTERVAL_SIGMAS, PLUS_MINUS, number, signed

if TYPE_CHECKING:
    from calibration.design.accuracy import ExpectedAccuracy

_STAGE_WORDS: dict[Stage, str] = {
    "nominal": "Nominal: the drawings",
    "geometric": "Geometric: true lengths and angles",
    "effects": "Effects: named physics added",
    "hybrid": "Hybrid: learned residual added",
}
_EXPLAINED = 1.15  # ratio to the instrument noise that a few dozen fixes cannot distinguish from 1
_OUTLIERS_SHOWN = 20
_PARAMETERS_SHOWN = 14
_COEFFICIENTS_SHOWN = 2
_FEATURES_SHOWN = 10
_MUCH_OPEN = 0.2  # of the expected error: the part that direction of approach, load or temperature determine
_KNOWN = "direction of approach, load and temperature known"
_UNKNOWN = "not known"


def calibration_report(report: ReportInput) -> str:
    """Return the report as one self-contained HTML document; the same input gives the same bytes."""
    with drawing.styled():
        parts = [
            _head(report),
            _accuracy(report),
            _expected(report),
            _by_joint(report),
            _axes(report),
            _coverage(report),
            _effects(report),
            _importance(report),
            _parameters(report),
            _outliers(report),
            _setups(report),
            timing(report.latencies, report.stations),
            markup.sources_section(report.provenance, _ignored(report)),
            signatures(),
        ]
    return markup.page(f"Calibration of {report.rig}", "".join(parts))


def headline(report: ReportInput) -> str:
    """Return one sentence with the error before and after calibration and the fixes it was judged on."""
    judged = report.judged
    before, after = judged.stage("nominal").rms_mm, judged.stage("hybrid").rms_mm
    verb = "falls" if after < before else "does not fall: it goes"
    change = f"the position error {verb} from {number(before)} mm to {number(after)} mm"
    if report.held_out is None:
        return f"On the {len(judged)} fixes it was fitted to, {change}."
    return f"On {len(judged)} held-out fixes, {change}."


def _meaning(report: ReportInput) -> str:
    after = report.judged.stage("hybrid").rms_mm
    if after <= _EXPLAINED * report.instrument_mm:
        judgement = "The instrument noise explains the remaining error."
    else:
        judgement = (
            f"The instrument noise explains {number(report.instrument_mm)} mm of the remaining error. The rest is "
            "physics that the model lacks, or measurements noisier than the rig file states."
        )
    where = (
        "No fixes were held out, so this is how well the model fits its own data, not the accuracy to expect. "
        if report.held_out is None
        else "The model never saw these fixes, so this is the accuracy to expect where the data cover the workspace. "
    )
    return where + judgement


def _head(report: ReportInput) -> str:
    before, after = report.judged.stage("nominal"), report.judged.stage("hybrid")
    tiles = [
        markup.Tile("before, root mean square", number(before.rms_mm)),
        markup.Tile("after, root mean square", number(after.rms_mm), kind="after"),
        markup.Tile("after, worst fix", number(after.max_mm), kind="after"),
        markup.Tile("instrument noise", number(report.instrument_mm)),
    ]
    moved = [
        f"Station set-up {setup.name!r} moved: its fixes do not fit together." for setup in report.setups if setup.moved
    ]
    facts = report.facts or Facts(report.rig)
    first = front(facts, _verdict(report, facts.tolerance_mm), _accuracy_sentence(report))
    notes = [in_words(text) for text in [*report.warnings, *moved]]
    return markup.header(f"Calibration report: {report.rig}", first, headline(report), _meaning(report), tiles) + (
        markup.notice(notes)
    )


def _rows(report: ReportInput) -> str:
    if report.held_out is None:
        return f"on the {len(report.judged)} fixes it was fitted to"
    return f"on {len(report.judged)} held-out fixes"


def _verdict(report: ReportInput, tolerance_mm: float | None) -> Verdict | None:
    rms_mm = report.judged.stage("hybrid").rms_mm
    return judge(tolerance_mm, rms_mm, is_held_out=report.held_out is not None, rows=_rows(report))


def _accuracy_sentence(report: ReportInput) -> Accuracy:
    """Return the accuracy of the model on the judged fixes, and over the work volume."""
    after = report.judged.stage("hybrid")
    sentence = (
        f"Accuracy: {number(after.rms_mm)} mm root mean square {_rows(report)}, {number(after.max_mm)} mm at worst"
    )
    expected = report.expected
    if expected is None:
        return Accuracy(f"{sentence}.")
    sentence += "; over the whole work volume the expected error of the model itself is"
    if not _depends_on_more(expected):
        return Accuracy(f"{sentence} {number(expected.rms_mm)} mm.")
    known_mm = float(np.hypot(expected.parameters_mm, expected.lacking_mm))
    return Accuracy(f"{sentence}:", {_KNOWN: known_mm, _UNKNOWN: expected.rms_mm})


def _depends_on_more(expected: ExpectedAccuracy) -> bool:
    """True if the error depends so much on more than the pose that accuracy is shown with and without the rest."""
    return expected.open_mm > _MUCH_OPEN * expected.rms_mm


def _accuracy(report: ReportInput) -> str:
    judged = report.judged
    what = f"{len(judged)} fixes that the model was fitted to" if report.held_out is None else "held-out fixes"
    rows = []
    for stage in STAGES:
        s = judged.stage(stage)
        cells = [_STAGE_WORDS[stage], *(number(v) for v in (s.mean_mm, s.rms_mm, s.max_mm, s.std_mm))]
        if report.held_out is not None:
            cells.append(number(report.training.stage(stage).rms_mm))
        rows.append(cells)
    columns = ["stage of the model", "mean, mm", "root mean square, mm", "worst, mm", "standard deviation, mm"]
    if report.held_out is not None:
        columns.append("root mean square where fitted, mm")
    stages = markup.table(columns, rows, classes=["", "", "", "best"], caption=f"Position error in space on the {what}")
    note = markup.paragraph(_stage_notes(report), "note")
    return markup.section(
        "How accurate the model is",
        stages,
        note,
        _per_prism(judged),
        drawing.picture(
            figures.errors_by_prism(report),
            "Position error of every fix per prism before and after calibration, on a logarithmic axis",
            "Every dot is one fix; the axis is logarithmic. The number next to each bar is the root mean square in mm.",
        ),
    )


def _stage_notes(report: ReportInput) -> str:
    errors = report.judged.errors_mm
    sentences = []
    if np.array_equal(errors["effects"], errors["geometric"]):
        sentences.append(
            f"No named effect is part of this model ({in_words(report.effects_reason)}), so that stage repeats the one "
            "before it."
        )
    sentences.append(f"Learned residual: {in_words(report.residual_reason).rstrip('.')}.")
    sentences.append(f"Scatter of a single fix about the fitted model: {number(report.noise_mm)} mm.")
    return " ".join(sentences)


def _per_prism(judged: ErrorTable) -> str:
    rows = []
    for prism in judged.prisms:
        spreads = [judged.stage(stage, prism) for stage in STAGES]
        rows.append(
            [prism, str(spreads[0].n), *(number(s.rms_mm) for s in spreads), number(spreads[-1].max_mm)],
        )
    columns = ["prism", "fixes", "nominal, mm", "geometric, mm", "effects, mm", "hybrid, mm", "worst, mm"]
    return markup.table(columns, rows, caption="Root mean square per prism, and the worst fix after calibration")


def _expected(report: ReportInput) -> str:
    if report.expected is None:
        return ""
    rows, columns = _expected_rows(report.expected)
    place = f" at set-up {report.expected.setup!r}" if report.expected.setup else ""
    return markup.section(
        "What to expect elsewhere",
        markup.paragraph(
            f"Expected error of the model itself, without the noise of a fix, in {len(report.expected.readings)} poses "
            f"of the whole work volume{place}, measured or not: {number(report.expected.rms_mm)} mm root mean square, "
            f"{report.expected.where}."
        ),
        markup.table(columns, rows, caption="Expected error in mm of each prism"),
    )


def _expected_rows(expected: ExpectedAccuracy) -> tuple[list[list[str]], list[str]]:
    """Return rows and headings of the expected errors, with two columns if they depend on more than the pose."""
    columns = ["prism", "root mean square", "median", "95 % within", "99 % within"]
    rows = [
        [prism, *(number(value) for value in (of.rms_mm, of.median_mm, of.p95_mm, of.p99_mm))]
        for prism, of in expected.per_prism.items()
    ]
    if not _depends_on_more(expected):
        return rows, columns
    closed_mm2 = np.trace(expected.parameters_mm2 + expected.lacking_mm2, axis1=2, axis2=3)
    known = [number(float(value)) for value in np.sqrt(closed_mm2.mean(axis=0))]
    columns[1:2] = [f"root mean square, {_KNOWN}", f"root mean square, {_UNKNOWN}"]
    return [[row[0], value, *row[1:]] for row, value in zip(rows, known, strict=True)], columns


def _axes(report: ReportInput) -> str:
    if not report.axes:
        return ""
    rows, classes = [], []
    for axis in report.axes:
        offset = f"{number(axis.offset_mm)} {PLUS_MINUS} {number(axis.offset_sigma_mm, 2)}"
        angle = f"{number(axis.angle_deg)} {PLUS_MINUS} {number(axis.angle_sigma_deg, 2)}"
        chance = number(min(axis.p_axis, axis.p_curve))
        rows.append([joint_words(axis.joint), axis.prism, angle, offset, chance, "disagrees" if axis.sentence else ""])
        classes.append("flag" if axis.sentence else "")
    return markup.section(
        "Axes measured by single-joint sweeps",
        markup.paragraph(
            "Where one joint moved alone, the circle or line of the prism shows the joint's axis without any model. "
            "This axis is compared with that of the calibrated model; intervals are one standard deviation."
        ),
        markup.table(
            ["joint", "prism", "angle between, degrees", "distance, mm", "probability by chance", "remark"],
            rows,
            text_columns=(0, 1, 5),
            classes=classes,
        ),
    )


def _by_joint(report: ReportInput) -> str:
    return markup.section(
        "Remaining error, joint by joint",
        markup.paragraph(
            "If the model is complete, the dots scatter evenly about zero at every joint reading. A line that bends "
            "or drifts is physics that the model lacks: play, sag, or an uneven encoder at that joint."
        ),
        drawing.picture(
            figures.residual_by_joint(report),
            "Remaining error components x, y and z against each joint value, with running medians",
            "Measured minus predicted, in the rig's base frame. The lines are running medians; dots beyond the axis "
            "are drawn at its edge.",
        ),
    )


def _coverage(report: ReportInput) -> str:
    return markup.section(
        "Where it was measured",
        markup.paragraph("The model is only as good as its poses: expect less accuracy where there are no dots."),
        "<h3>Joint ranges</h3>",
        drawing.picture(
            figures.joint_coverage(report),
            "Fixes within the range of every joint",
            "Grey is the joint's whole range; every stroke is one fix.",
        ),
        "<h3>Workspace</h3>",
        drawing.picture(
            figures.workspace(report),
            "Prism positions in plan and side view",
            "Prism positions in the rig's base frame; the cross is its origin.",
        ),
        "<h3>Remaining error in the workspace</h3>",
        drawing.picture(
            figures.error_map(report),
            "Remaining error over the workspace in plan and side view",
            "Dark is worse. A patch of one colour points at a region; scattered colours are noise.",
        ),
    )


def _effects(report: ReportInput) -> str:
    if not report.effects:
        return ""
    rows: list[list[str]] = []
    for effect in report.effects:
        head = [effect.family.replace("_", " "), effect.where, f"{number(effect.change)} {unit_words(effect.unit)}"]
        for name, value, sigma, unit in effect.coefficients[:_COEFFICIENTS_SHOWN]:
            spoken = unit_words(unit)
            interval = f"{PLUS_MINUS} {number(INTERVAL_SIGMAS * sigma, 2)} {spoken}"
            rows.append([*head, coefficient_words(name), f"{signed(value)} {spoken}", interval])
            head = [""] * 3
        more = len(effect.coefficients) - _COEFFICIENTS_SHOWN
        if more > 0:
            rows.append([*head, f"and {more} more, which shape its curve", "", ""])
    columns = [
        "effect",
        "where",
        "changes the joint, or moves the prism, by up to",
        "coefficient",
        "value",
        "95 % interval",
    ]
    return markup.section(
        "Named effects",
        markup.paragraph(
            "Physics beyond true lengths and angles, fitted together with them: "
            f"{in_words(report.effects_reason).rstrip('.')}."
        ),
        markup.table(columns, rows, text_columns=(0, 1, 3)),
    )


def _importance(report: ReportInput) -> str:
    if not report.importance:
        return ""
    shown = min(_FEATURES_SHOWN, len(report.importance))
    return markup.section(
        "Features of the learned residual",
        markup.paragraph(
            f"The {shown} most important of the {len(report.importance)} features of the trees. Features with the "
            "same information share their gain, and importance does not prove a cause."
        ),
        drawing.picture(
            figures.importance(report, shown),
            "Share of each feature in the gain of all splits of the trees, the most important first",
            "Share of each feature in the reduction of the squared error of the training rows by all splits.",
        ),
    )


def _parameters(report: ReportInput) -> str:
    lines = sorted(report.parameters, key=lambda p: -abs(p.in_tolerances))
    unusual = sum(p.is_unusual for p in lines)
    beyond = sum(p.is_beyond_building for p in lines)
    content = [markup.paragraph(_identifiability_words(report))]
    if report.unidentifiable:
        content.append(markup.items(in_words(text) for text in report.unidentifiable))
    if lines:
        rows, classes = [], []
        for p in lines[:_PARAMETERS_SHOWN]:
            remark = "beyond building: check the drawing" if p.is_beyond_building else "unusual" if p.is_unusual else ""
            remark = remark or ("" if p.determined else "not determined")
            rows.append(
                [
                    constant_words(p.name),
                    f"{signed(p.correction)} {unit_words(p.unit)}",
                    f"{PLUS_MINUS} {number(INTERVAL_SIGMAS * p.sigma, 2)} {unit_words(p.unit)}",
                    f"{number(p.tolerance)} {unit_words(p.unit)}",
                    signed(p.in_tolerances, 2),
                    remark,
                ]
            )
            classes.append("flag" if p.is_unusual else "")
        columns = ["constant", "correction", "95 % interval", "tolerance", "in tolerances", "remark"]
        content += [
            markup.paragraph(
                f"The {min(len(lines), _PARAMETERS_SHOWN)} largest of {len(lines)} corrections. "
                f"{_unusual_words(unusual, beyond)}"
            ),
            drawing.picture(
                figures.corrections(report, _PARAMETERS_SHOWN),
                "Largest corrections in build tolerances",
                "Bars are 95 % intervals. A diamond marks a constant that the data do not determine.",
            ),
            markup.table(columns, rows, text_columns=(0, 5), classes=classes),
        ]
    return markup.section("What was corrected", *content)


def _unusual_words(unusual: int, beyond: int) -> str:
    if not unusual:
        return f"None of them is larger than {USUAL:g} build tolerances."
    words = (
        f"{unusual} {'is' if unusual == 1 else 'are'} larger than {USUAL:g} build tolerances; by chance, one in 20 is."
    )
    if not beyond:
        return f"{words} None is larger than {BEYOND_BUILDING:g}."
    verb = "is" if beyond == 1 else "are"
    return f"{words} {beyond} {verb} larger than {BEYOND_BUILDING:g}, which building errors do not explain."


def _identifiability_words(report: ReportInput) -> str:
    if report.rank >= report.n_parameters:
        return f"The data determine all {report.n_parameters} parameters of the model."
    words = f"The data determine {report.rank} of {report.n_parameters} parameters or combinations of them. "
    if not report.unidentifiable:
        return words + "The others stay near the drawings, within the build tolerances."
    return (
        words + "These data cannot distinguish the following from others; the build tolerances divide the correction "
        "among them:"
    )


def _outliers(report: ReportInput) -> str:
    if not report.outliers:
        return markup.section("Fixes set aside", markup.paragraph("None: every fix was used."))
    worst = sorted(report.outliers, key=lambda o: -o.sigmas)[:_OUTLIERS_SHOWN]
    share = 100 * len(report.outliers) / len(report.training)
    words = (
        f"{len(report.outliers)} of {len(report.training)} fixes ({number(share, 2)} %) did not agree with the others "
        "and had little or no weight in the fit. They still count in every figure of this report."
    )
    rows = [[o.row, o.prism, number(o.error_mm), number(o.sigmas, 2)] for o in worst]
    columns = ["fix", "prism", "error, mm", "in standard deviations"]
    caption = f"The {len(worst)} worst" if len(worst) < len(report.outliers) else ""
    return markup.section(
        "Fixes set aside", markup.paragraph(words), markup.table(columns, rows, text_columns=(0, 1), caption=caption)
    )


def _setups(report: ReportInput) -> str:
    if not report.setups:
        return ""
    return markup.section("Station set-ups", *(_setup(setup) for setup in report.setups))


def _setup(setup: SetupLine) -> str:
    state = "moved during the session" if setup.moved else "did not move"
    text = f"<h3>{markup.escape(setup.name)}</h3>" + markup.paragraph(f"{setup.instrument}; {state}.")
    if not setup.control_points:
        return text + markup.paragraph("No control points were measured.", "note")
    rows = []
    for point in setup.control_points:
        cells = [point.name]
        for misclosure in (point.start_mm, point.end_mm):
            if misclosure is None:
                cells += [DASH] * 2
                continue
            cells += [", ".join(signed(v, 2) for v in misclosure), number(sum(v * v for v in misclosure) ** 0.5, 2)]
        rows.append(cells)
    columns = ["control point", "start x, y, z, mm", "size, mm", "end x, y, z, mm", "size, mm"]
    return text + markup.table(columns, rows, caption="Misclosure: measured minus known")


def _ignored(report: ReportInput) -> str:
    names = ", ".join(report.ignored_columns)
    return markup.paragraph(f"Columns of the data that were ignored: {names}.", "note") if names else ""
