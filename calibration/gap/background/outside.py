"""Formulas of effects outside the library, as blocks of a background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.columns import NO_JOINT, EffectColumns
from calibration.gap.background.blocks import Block
from calibration.gap.background.search import background_log_bayes_factor
from calibration.gap.candidates import CandidateEffect
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.joint_fit import JointFit, Problem, along
from calibration.gap.projected.projection import Projection
from calibration.identification.refinement import refine
from calibration.observations import Floats

MOST_FORMULAS = 3  # largest number of formulas to explain the residuals
_SAME = 0.995  # an effect is equivalent to a formula if it explains this share of the formula's squares


def formula_block(formula: Formula, number: int) -> Block:
    """Return the block of a formula; the prior sigma is the size of its coefficient."""
    return Block(f"formula{number}", "formula", formula.term.source.where, str(formula.term), _columns([formula]))


def is_in_library(formula: Formula, candidates: Sequence[CandidateEffect], over: Projection) -> bool:
    """Return True if a formula is equivalent to an effect of the library.

    Args:
        formula: a formula of the grammar.
        candidates: effects of the library.
        over: the projection in which they are compared.
    """
    target = over.columns(formula.term.moved_mm[:, :, None])[:, 0]
    for candidate in candidates:
        if candidate.where != formula.term.source.where:
            continue
        for option in sorted(set(candidate.first_equal)):
            columns = over.columns(over.moved_mm(candidate.additions[option]))
            left = target - columns @ np.linalg.lstsq(columns, target)[0]
            if float(left @ left) < (1.0 - _SAME) * float(target @ target):
                return True
    return False


def residual_formula(problem: Problem, joint: JointFit, formulas: Sequence[Formula]) -> tuple[Formula, ...]:
    """Return the best formula of the residuals when formulas are fitted together with kinematics and effects.

    Args:
        problem: the data.
        joint: kinematics and effects.
        formulas: formulas to include in the fit.

    Returns:
        One formula, or empty if only noise is left.
    """
    grammar = grammar_of_residuals(problem, joint, _columns(formulas) if formulas else None)
    return grammar.find(1) if detect(grammar, problem.rng()).significant else ()


def grammar_of_residuals(problem: Problem, joint: JointFit, additions: EffectColumns | None) -> Grammar:
    """Return the grammar of the residuals when further columns are fitted together with kinematics and effects.

    Args:
        problem: the data.
        joint: kinematics and effects.
        additions: further columns; None for none.
    """
    solution, explained = problem.solution, problem
    if additions is not None:
        additions = along(solution, [additions])
        fit = refine(solution.chain, solution.samples, solution.fit.x, prior=problem.prior, additions=additions)
        explained = replace(problem, solution=replace(solution, fit=fit, additions=additions))
    return Grammar(explained.project(explained.fit(joint.choices, explained.solution.fit.x)))


def formulas_suffice(problem: Problem, joint: JointFit, formulas: tuple[Formula, ...]) -> bool:
    """Return True if a few further formulas, equivalent to library effects or not, explain all residual structure.

    Args:
        problem: the data.
        joint: kinematics and effects.
        formulas: formulas found before.
    """
    for _ in range(MOST_FORMULAS):
        further = residual_formula(problem, joint, formulas)
        if not further:
            return True
        formulas += further
    return False


def cost_with_formulas(problem: Problem, joint: JointFit, formulas: tuple[Formula, ...]) -> float:
    """Return the cost of effects together with the formulas of their residuals, nats.

    Args:
        problem: the data.
        joint: kinematics and effects.
        formulas: formulas found before; a few more are added.
    """
    return _cost(problem, joint, _blocks(problem, joint, formulas))


def formulas_log_bayes_factor(problem: Problem, joint: JointFit, formulas: tuple[Formula, ...]) -> float:
    """Return the log Bayes factor of formulas given effects, the larger of two: with fixed and with refitted scatter.

    Arguments are those of `cost_with_formulas`.
    """
    blocks = _blocks(problem, joint, formulas)
    gained = joint.fit.cost - _cost(problem, joint, blocks)
    return max(gained, background_log_bayes_factor(problem, joint, blocks))


def _blocks(problem: Problem, joint: JointFit, formulas: tuple[Formula, ...]) -> list[Block]:
    for _ in range(MOST_FORMULAS):
        formulas += residual_formula(problem, joint, formulas)
    return [formula_block(formula, number) for number, formula in enumerate(formulas)]


def _cost(problem: Problem, joint: JointFit, blocks: Sequence[Block]) -> float:
    solution, columns = problem.solution, [block.columns for block in blocks]
    start = np.append(joint.fit.x, np.zeros(sum(map(len, columns))))
    additions = along(solution, [*joint.parts, *columns])
    return refine(solution.chain, solution.samples, start, prior=problem.prior, additions=additions).cost


def _columns(formulas: Sequence[Formula]) -> EffectColumns:
    moved: Floats = np.stack([f.term.moved_mm for f in formulas], axis=2)
    return EffectColumns(
        tuple(str(f.term) for f in formulas),
        np.full(len(formulas), NO_JOINT),
        np.zeros((len(moved), len(formulas))),
        np.array([abs(f.coefficient) for f in formulas]),
        moved,
    )
