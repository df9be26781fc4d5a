"""SQL conditions on places, (boot, monotonic time), that can use an index fully when a place comes from another table.

For `(boot_id, monotonic_ns) >= (?, ?)` SQLite searches an index by both columns. If the right side consists of columns
of another table, it searches by the first column only and reads the whole boot. Such queries therefore go boot by boot,
in order of time: `FROM ... CROSS JOIN boots CROSS JOIN table AS row WHERE` these conditions. The unary plus keeps the
planner from searching the rows by a range of boots instead.
"""

from __future__ import annotations

LEAST_NS, MOST_NS = -(2**63), 2**63 - 1

Sql = tuple[str, str]
"""SQL expressions of a place: its boot and its monotonic time."""


def since(row: str, place: Sql) -> str:
    """Return the condition that a row is at the place or later.

    Args:
        row: alias of the row with the prefix of its columns, such as `chunk.last_`.
        place: columns of a table earlier in the FROM clause, or parameters.
    """
    boot, at_ns = place
    return (
        f"+boots.id >= {boot} AND {row}boot_id = boots.id\n"
        f"    AND {row}monotonic_ns >= iif(boots.id = {boot}, {at_ns}, {LEAST_NS})"
    )


def between(row: str, first: Sql, last: Sql) -> str:
    """Return the condition that a row is between two places, both included.

    Args:
        row: alias of the row with the prefix of its columns.
        first: the first place, as for `since`.
        last: the last place, likewise.
    """
    boot, at_ns = last
    until = f"+boots.id <= {boot} AND {row}monotonic_ns <= iif(boots.id = {boot}, {at_ns}, {MOST_NS})"
    return f"{since(row, first)}\n    AND {until}"
