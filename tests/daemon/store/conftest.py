"""A sound record, and copies of it that a test may damage."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.daemon.store.damaged import make_sound


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state of a site with rows of every kind, stopped in order; not to be changed."""
    state = tmp_path_factory.mktemp("sound") / "state"
    make_sound(state)
    return state


@pytest.fixture
def state(sound: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(sound, tmp_path / "state"))
