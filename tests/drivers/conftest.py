"""What the tests of drivers share."""

from __future__ import annotations

import pytest

from drivers.genicam import gentl
from tests.programs import Forked


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fork the processes of cameras behind a producer: to start Python takes half a second each."""
    monkeypatch.setattr(gentl, "subprocess", Forked)
