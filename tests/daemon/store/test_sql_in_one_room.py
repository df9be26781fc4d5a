"""SQL is written in the store's room alone: whoever changes a table finds its queries beside it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import daemon

ROOM = Path(daemon.__file__).parent
SQL = re.compile(
    r"\b(SELECT\s.+\sFROM|INSERT\s+(OR\s+\w+\s+)?INTO|UPDATE\s+\S+\s+SET|DELETE\s+FROM|PRAGMA\s|WHERE\s.+=|ORDER\s+BY)\b",
    re.DOTALL,
)


def texts(path: Path) -> list[str]:
    """Return all strings in a file's code."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]


def test_only_the_store_has_sql() -> None:
    has_sql = {path for path in ROOM.glob("**/*.py") if any(SQL.search(text) for text in texts(path))}
    assert has_sql
    assert not {path for path in has_sql if not path.is_relative_to(ROOM / "store")}
