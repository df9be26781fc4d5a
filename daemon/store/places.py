"""Conditions on places, (boot, monotonic time), that an index serves whole where a place is of another table's row.

SQLite searches an index by both columns for `(boot_id, monotonic_ns) >= (?, ?)`, but by the first alone, and reads the
whole boot, where columns of another table stand on the right. So such queries go boot by boot, in the order of time:
`FROM ... CROSS JOIN boots CROSS JOIN table AS row WHERE` these conditions. The plus keeps the planner from searching
the rows by a range of boots instead.
"""

from __future__ import annotations

LEAST_NS, MOST_NS = -(2**63), 2**63 - 1

Sql = tuple[str, str]
"""A place in SQL: its boot and its monotonic time."""


def since(row: str, place: Sql) -> str:
    """Return the condition that a row is of the place or later.

    Args:
        row: its alias with what its columns begin with, `chunk.last_`.
        place: columns of a table that stands before, or parameters.
    """
    boot, at_ns = place
    return (
        f"+boots.id >= {boot} AND {row}boot_id = boots.id\n"
        f"    AND {row}monotonic_ns >= iif(boots.id = {boot}, {at_ns}, {LEAST_NS})"
    )


def between(row: str, first: Sql, last: Sql) -> str:
    """Return the condition that a row is of the first place, of the last one, or between them."""
    boot, at_ns = last
    until = f"+boots.id <= {boot} AND {row}monotonic_ns <= iif(boots.id = {boot}, {at_ns}, {MOST_NS})"
    return f"{since(row, first)}\n    AND {until}"
