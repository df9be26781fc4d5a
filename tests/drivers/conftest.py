"""A serial CAN adapter, as links find it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drivers.can_support import Adapter, plugged_adapter


@pytest.fixture
def adapter(tmp_path: Path) -> Iterator[Adapter]:
    with plugged_adapter(tmp_path / "slcan") as plugged:
        yield plugged
