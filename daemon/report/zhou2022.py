"""Section 4 of the first paper as a page: its tables next to the paper's own figures, and its plots."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from calibration.experiments.zhou2022.held_out import PAPER as PAPER_TRAJECTORY
from calibration.experiments.zhou2022.held_out import LearningPoint, Trajectory
from calibration.experiments.zhou2022.protocol import PAPER_BEFORE, Protocol
from calibration.experiments.zhou2022.table3 import PAPER_AFTER, Way
from calibration.experiments.zhou2022.weights import Front
from daemon.report import drawing, markup
from daemon.report.front import Accuracy, Facts, front, judge, signatures
from daemon.report.plain_names import in_words
from daemon.report.words import DASH, PLUS_MINUS, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WAYS: Mapping[Way, str] = {"paper": "the paper's DE", "converged": "converged", "base free": "converged, base free"}
_WAY_COLOURS: Mapping[Way, str] = {"paper": drawing.MIDDLE, "converged": drawing.AFTER, "base free": "#56b4e9"}
PATH_NAMES: Mapping[str, str] = {
    "before": "before (nominal)",
    "geometric": "geometric",
    "rbfn": "geometric, radial basis function network",
    "lightgbm": "geometric, gradient-boosted trees",
    "chain": "geometric, network and trees (the paper's hybrid)",
    "hybrid": "hybrid (rigcal's default)",
}
_PATH_LINES = (("before", drawing.BEFORE, 1.2), ("geometric", drawing.MIDDLE, 1.2), ("hybrid", drawing.AFTER, 1.8))
_SMOOTHED = 24  # points; shorter trajectories are drawn without smoothing


def protocol_page(protocol: Protocol, sources: Mapping[str, str], facts: Facts | None = None) -> str:
    """Return one self-contained HTML document.

    Args:
        protocol: the experiments.
        sources: label -> origin of the data.
        facts: the first lines of the page; by default the rig's name alone.
    """
    with drawing.styled():
        content = [
            _head(protocol, facts or Facts(protocol.rig)),
            _before(protocol),
            _identification(protocol),
            _front(protocol.front),
            _learning(protocol),
            _trajectory(protocol.trajectory),
            markup.sources_section(sources),
            signatures(),
        ]
    return markup.page(f"Zhou et al. 2022, section 4: {protocol.rig}", "".join(content))


def before_table(protocol: Protocol) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: prism, then fixes, mean and the paper's mean for each kind of motion."""
    published = any(prism in PAPER_BEFORE["multi-joint"] for prism in prisms_of(protocol))
    columns = ["prism"]
    for before in protocol.before:
        columns += [f"{before.motion} fixes", "mean, mm", *(["paper, mm"] if published else [])]
    rows = []
    for prism in prisms_of(protocol):
        cells = [prism]
        for before in protocol.before:
            cells += [str(before.fixes.get(prism, 0)), _cell(before.mean_mm.get(prism))]
            cells += [_cell(PAPER_BEFORE[before.motion].get(prism))] if published else []
        rows.append(cells)
    return columns, rows


def identification_table(protocol: Protocol) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of Table 3: mean held-out error per prism, and the objective."""
    prisms = prisms_of(protocol)
    columns = ["data", "by", *prisms, "objective, mm\N{SUPERSCRIPT TWO}", "at bounds", "seconds"]
    rows = [["nominal", DASH, *(_cell(protocol.held_out_before_mm.get(p)) for p in prisms), "", "", ""]]
    rows += [
        [
            line.data,
            WAYS[line.way] + ("" if line.complete else " (stopped)"),
            *(_cell(line.held_out_mm.get(p)) for p in prisms),
            number(line.objective_mm2),
            str(line.at_bounds),
            number(line.seconds),
        ]
        for line in protocol.identified
    ]
    return columns, rows


def paper_rows(protocol: Protocol) -> list[list[str]]:
    """Return the paper's own Table 3 in the columns of `identification_table`; nothing for other prisms."""
    prisms = prisms_of(protocol)
    if not any(prism in values for prism in prisms for values in PAPER_AFTER.values()):
        return []
    return [
        [data, "as published", *(_cell(values.get(p)) for p in prisms), "", "", ""]
        for data, values in PAPER_AFTER.items()
    ]


def trajectory_table(path: Trajectory) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: mean and standard deviation along the path, next to the paper's."""
    rows = []
    for name, label in PATH_NAMES.items():
        error = path.error_mm[name]
        mean, std = PAPER_TRAJECTORY.get(name, (None, None))
        remark = " (not adopted)" if name in path.left_out else ""
        rows.append([label + remark, number(float(error.mean())), number(float(error.std())), _cell(mean), _cell(std)])
    return ["predicted with", "mean, mm", "std, mm", "paper mean, mm", "paper std, mm"], rows


def learning_table(points: tuple[LearningPoint, ...]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: median and range of the held-out RMS by number of training poses."""

    def span(values: tuple[float, ...]) -> list[str]:
        if not values:
            return [DASH, DASH]
        whole = number(min(values)) if len(values) == 1 else f"{number(min(values))} .. {number(max(values))}"
        return [number(float(np.median(values))), whole]

    rows = [[str(p.poses), str(len(p.hybrid_mm)), *span(p.geometric_mm), *span(p.hybrid_mm)] for p in points]
    return ["poses", "draws", "geometric, mm", "range", "hybrid, mm", "range"], rows


def prisms_of(protocol: Protocol) -> list[str]:
    """Return the prisms of the training or held-out rows, those at the tip first as in the paper."""
    found = [name for before in protocol.before for name in before.mean_mm] + list(protocol.held_out_before_mm)
    order = {name: place for place, name in enumerate("rsbw")}
    return sorted(dict.fromkeys(found), key=lambda name: order.get(name, len(order)))


def not_taken(path: Trajectory) -> list[str]:
    """Return a sentence for each learner that was left out."""
    return [f"{PATH_NAMES[name]}: no learner was adopted: {reason}" for name, reason in path.left_out.items()]


def weights_sentence(front: Front) -> str:
    """Return a sentence on the chosen weights."""
    weights = ", ".join(f"{name} {number(mu, 2)}" for name, mu in front.weight.items())
    return (
        f"Chosen weights: {weights}. Of the {sum(not p.dominated for p in front.points)} points of the front among "
        f"{len(front.points)} sets of weights, this is the nearest to the best of every prism, in units of that best."
    )


def _cell(value: float | None) -> str:
    return DASH if value is None else number(value)


def _head(protocol: Protocol, facts: Facts) -> str:
    path = protocol.trajectory.error_mm
    before, after = (float(path[name].mean()) for name in ("before", "hybrid"))
    sentence = (
        f"Along {len(protocol.trajectory.rows)} held-out points of prism {protocol.trajectory.prism} the mean error "
        f"goes from {number(before)} mm to {number(after)} mm."
    )
    error_mm = protocol.trajectory.error_mm["hybrid"]
    rms_mm = float(np.sqrt(np.mean(error_mm**2)))
    rows = f"along {len(error_mm)} held-out points of prism {protocol.trajectory.prism}"
    verdict = judge(facts.tolerance_mm, rms_mm, is_held_out=True, rows=rows)
    size = f"{protocol.training} fixes were fitted and {protocol.held_out} held out"
    accuracy = Accuracy(f"Accuracy: {number(rms_mm)} mm root mean square {rows}; {size}.")
    lead = (
        "The experiments of Zhou et al. (2022), section 4, on other data. The paper's own figures are of a machine "
        "whose drawings were a metre off: compare ratios, not millimetres."
    )
    title = f"Zhou et al. 2022, section 4: {protocol.rig}"
    notes = [in_words(text) for text in dict.fromkeys(protocol.warnings)]
    return markup.header(title, front(facts, verdict, accuracy), sentence, lead) + markup.notice(notes)


def _before(protocol: Protocol) -> str:
    columns, rows = before_table(protocol)
    return markup.section(
        "Before calibration",
        markup.paragraph("Mean error of the nominal model on the training fixes, its base placed with the same fixes."),
        markup.table(columns, rows),
    )


def _identification(protocol: Protocol) -> str:
    columns, rows = identification_table(protocol)
    published = ""
    if paper := paper_rows(protocol):
        caption = "The paper's own table, of its machine, in mm"
        published = markup.table(columns[:-3], [row[:-3] for row in paper], text_columns=(0, 1), caption=caption)
    return markup.section(
        "Identification (Table 3)",
        markup.paragraph(
            "The constants of the rows, identified from single-joint data, from multi-joint data, and from all data "
            "with the weights chosen below. Base and unknown prism offsets stay at their nominal values, because the "
            "paper treats them as known. Each set of data is solved twice: by the paper's differential evolution at "
            "its settings (30,000 candidates, 400 generations, data shuffled and the search repeated), and as the "
            "converged optimum of the same objective (Eq. 19) within the same bounds. Where the two objectives differ, "
            "the search had not converged. With the base free, base and unknown offsets are fitted too, which shows "
            "the cost of holding them. At bounds: the number of constants that ended at one of their bounds."
        ),
        markup.table(columns, rows, text_columns=(0, 1), caption="Mean error on the held-out fixes in mm, per prism"),
        published,
        drawing.picture(
            identification_figure(protocol),
            "Held-out mean error per prism, data set and way of solving",
            "Mean error on the held-out fixes; every prism has its own scale, logarithmic.",
        ),
    )


def identification_figure(protocol: Protocol) -> Figure:
    """Draw a panel for each prism, with dots by data set and way of solving."""
    prisms = [p for p in prisms_of(protocol) if p in protocol.held_out_before_mm]
    sets = list(dict.fromkeys(line.data for line in protocol.identified))
    figure = drawing.new_figure(1.35 + 0.7 * max(len(sets), 1))
    grid = figure.subplots(1, len(prisms), sharey=True, squeeze=False)[0]
    for axes, prism in zip(grid, prisms, strict=True):
        nominal = protocol.held_out_before_mm[prism]
        known = [nominal, *(line.held_out_mm[prism] for line in protocol.identified)]
        axes.axvline(nominal, color=drawing.INK, linewidth=1, linestyle=(0, (4, 3)), label="nominal model")
        for number_of_way, (way, colour) in enumerate(_WAY_COLOURS.items()):
            lines = [line for line in protocol.identified if line.way == way]
            values = [line.held_out_mm[prism] for line in lines]
            places = [sets.index(line.data) + 0.27 * (number_of_way - 1) for line in lines]
            axes.plot(values, places, "o", color=colour, markersize=6, label=WAYS[way])
            for value, place in zip(values, places, strict=True):
                text = axes.annotate(number(value), (value, place), (6, 0), textcoords="offset points", va="center",
                    fontsize=8)  # fmt: skip
                # On the dashed line a number needs a background.
                text.set_bbox({"facecolor": axes.get_facecolor(), "edgecolor": "none", "pad": 0.5})
        axes.set_title(f"prism {prism}")
        drawing.plain_log_axis(axes, "x")
        span = max(max(known) / min(known), 2.0)
        axes.set_xlim(min(known) / span**0.1, max(known) * span**0.35)
        axes.set_xlabel("mm")
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0, labelcolor=drawing.INK)
        axes.set_yticks(range(len(sets)), sets)
    grid[0].invert_yaxis()
    handles, labels_ = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels_, loc="outside upper left", ncols=4)
    return figure


def _front(front: Front | None) -> str:
    if front is None:
        return ""
    return markup.section(
        "Pareto front of the weights",
        markup.paragraph(
            "The optimum of Eq. 19 was found for every set of weights on two thirds of the training poses; the errors "
            f"are those of the other third. {weights_sentence(front)} The held-out fixes were not used."
        ),
        drawing.picture(
            front_figure(front),
            "Errors of every two prisms over all sets of weights",
            "Root mean square errors of two prisms against each other. Blue: no other set of weights is better at one "
            "prism and worse at none (of all prisms, not only of these two); grey: dominated; red star: chosen.",
        ),
    )


def front_figure(front: Front) -> Figure:
    """Draw the prisms' errors over the grid of weights, every two against each other."""
    names = list(front.weight)
    pairs = list(combinations(names, 2))
    columns = min(3, len(pairs))
    lines = -(-len(pairs) // columns)
    figure = drawing.new_figure(0.4 + 2.7 * lines)
    grid = figure.subplots(lines, columns, squeeze=False)
    for axes in grid.ravel()[len(pairs) :]:
        axes.set_visible(False)
    groups = (
        (drawing.BEFORE, 12, 0.5, [p for p in front.points if p.dominated], "dominated"),
        (drawing.AFTER, 18, 0.85, [p for p in front.points if not p.dominated], "Pareto front"),
    )
    chosen = front.points[front.chosen]
    for axes, (first, second) in zip(grid.ravel(), pairs, strict=False):
        for colour, size, alpha, points, label in groups:
            x, y = ([p.rms_mm[name] for p in points] for name in (first, second))
            axes.scatter(x, y, s=size, c=colour, alpha=alpha, linewidths=0, label=label)
        axes.plot(
            chosen.rms_mm[first], chosen.rms_mm[second], "*", color=drawing.WARN, markersize=13,
            markeredgecolor="white", linestyle="", label="chosen weights",
        )  # fmt: skip
        axes.set_xlabel(f"prism {first}, mm")
        axes.set_ylabel(f"prism {second}, mm")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3)
    return figure


def _learning(protocol: Protocol) -> str:
    columns, rows = learning_table(protocol.learning)
    return markup.section(
        "How much data is enough",
        markup.paragraph(
            "Root mean square error on the held-out fixes after training on the given number of poses, drawn at random "
            "with all their fixes."
        ),
        drawing.picture(
            learning_figure(protocol.learning),
            "Held-out error against the number of training poses",
            "Lines: medians of the draws; bands: from the best draw to the worst.",
        ),
        markup.table(columns, rows),
    )


def learning_figure(points: tuple[LearningPoint, ...]) -> Figure:
    """Draw median and range of both stages' held-out error against the number of poses."""
    figure = drawing.new_figure(3.6)
    axes = figure.add_subplot()
    known = [point for point in points if point.hybrid_mm]
    poses = [point.poses for point in known]
    for label, colour, values in (
        ("geometric", drawing.MIDDLE, [point.geometric_mm for point in known]),
        ("hybrid", drawing.AFTER, [point.hybrid_mm for point in known]),
    ):
        axes.fill_between(poses, list(map(min, values)), list(map(max, values)), color=colour, alpha=0.18, linewidth=0)
        axes.plot(poses, [float(np.median(v)) for v in values], "o-", color=colour, markersize=4.5, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xscale("log")
    axes.set_xticks(poses, [str(n) for n in poses])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("training poses")
    axes.set_ylabel("held-out root mean square error, mm")
    figure.legend(loc="outside upper left", ncols=2)
    return figure


def _trajectory(path: Trajectory) -> str:
    columns, rows = trajectory_table(path)
    return markup.section(
        "Along the trajectory (Fig. 12)",
        drawing.picture(
            trajectory_figure(path),
            "Error of every point of the trajectory before and after",
            f"Held-out points of prism {path.prism}{' in the order of time' if path.in_time else ''}. Thin lines: "
            "every point; thick lines: the mean of seven neighbours.",
        ),
        markup.table(columns, rows, caption="The paper's figures are of its own machine"),
        markup.paragraph(
            "The paper's three learners start from the same identified kinematics, without effects. rigcal's default "
            "adds the named effects that the data support, and a learner only where it helps.",
            "note",
        ),
        *(markup.paragraph(f"{sentence}.", "note") for sentence in not_taken(path)),
    )


def trajectory_figure(path: Trajectory) -> Figure:
    """Draw the error along the path before and after, and a panel of means and standard deviations."""
    figure = drawing.new_figure(4.2)
    along, beside = figure.subplots(1, 2, width_ratios=[2.6, 1.0])
    points = np.arange(1, len(path.rows) + 1)
    for name, colour, width in _PATH_LINES:
        error = path.error_mm[name]
        label = f"{PATH_NAMES[name]}: {number(float(error.mean()))} {PLUS_MINUS} {number(float(error.std()))} mm"
        along.plot(points, error, color=colour, linewidth=0.8, alpha=0.45)
        if len(error) >= _SMOOTHED:
            smooth = np.convolve(np.pad(error, 3, mode="edge"), np.ones(7) / 7, mode="valid")
            along.plot(points, smooth, color=colour, linewidth=width + 0.6, label=label)
        else:
            along.plot(points, error, color=colour, linewidth=width, label=label)
    along.set_xlabel("point of the trajectory")
    along.set_ylabel("position error, mm")
    along.set_ylim(bottom=0)
    along.margins(x=0.01)
    names = [name for name in PATH_NAMES if name != "before"]
    short = {"rbfn": "network", "lightgbm": "trees", "chain": "paper's hybrid", "hybrid": "rigcal"}
    for place, name in enumerate(names):
        error = path.error_mm[name]
        colour = {"geometric": drawing.MIDDLE, "hybrid": drawing.AFTER}.get(name, drawing.SOFT)
        mean, std = float(error.mean()), float(error.std())
        beside.errorbar(mean, place, xerr=std, fmt="o", color=colour, capsize=3, markersize=5)
        beside.annotate(number(mean), (mean, place - 0.16), ha="center", va="bottom", fontsize=8)
    beside.set_yticks(range(len(names)), [short.get(name, name) for name in names])
    beside.set_ylim(len(names) - 0.4, -0.7)
    beside.set_xlim(left=0)
    beside.tick_params(axis="y", length=0, labelcolor=drawing.INK)
    beside.grid(False, axis="y")
    beside.set_xlabel("mean and standard deviation, mm")
    figure.legend(loc="outside upper left", ncols=3)
    return figure
