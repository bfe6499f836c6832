"""Calibrated sites, made once for all tests of the core, in whatever process they run."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from core.calibration.calibrate import Method
from drivers.sim.settings import Print, SimSettings
from drivers.sim.world import World
from tests.core.scenes import small_site
from tests.core.sessions import Session, session
from tests.shared import shared_directory

MakeSession = Callable[[str, float, SimSettings, int, int], Session]


@pytest.fixture(scope="session")
def shared_session(tmp_path_factory: pytest.TempPathFactory) -> MakeSession:
    """Give a session by name, distance (mm), settings, and numbers of lens views and positions."""

    def give(name: str, distance_mm: float, settings: SimSettings, lens: int, rig: int) -> Session:
        def fill(directory: Path) -> None:
            made = session(distance_mm, settings, lens=lens, rig=rig)
            content = pickle.dumps((made.views, made.calibration, made.report))
            (directory / "session").write_bytes(content)

        file = shared_directory(tmp_path_factory, name, fill) / "session"
        site = small_site(distance_mm)
        return Session(site, World(site, settings), *pickle.loads(file.read_bytes()))

    return give


@pytest.fixture(scope="session")
def lab(shared_session: MakeSession) -> Session:
    """11 m: twelve lens views, twelve head positions."""
    return shared_session("lab", 11000.0, SimSettings(seed=3), 12, 12)


@pytest.fixture(scope="session")
def field(shared_session: MakeSession) -> Session:
    """22 m, another rig."""
    return shared_session("field", 22000.0, SimSettings(seed=6), 12, 12)


@pytest.fixture(scope="session")
def printed(shared_session: MakeSession) -> Callable[[float], Session]:
    """Give the usual laboratory with a board whose lines are off by so many um, rms."""

    def give(line_error_um: float) -> Session:
        settings = SimSettings(seed=3, print=Print(line_error_um=line_error_um))
        return shared_session(f"printed-{line_error_um:g}um", 11000.0, settings, 8, 10)

    return give


@pytest.fixture(scope="session")
def paper(lab: Session) -> Session:
    """The laboratory's views by the paper's method."""
    return lab.calibrated_again(Method.PAPER)


@pytest.fixture(scope="session")
def usual(printed: Callable[[float], Session]) -> Session:
    """The laboratory with eight lens views and ten head positions, enough to measure well."""
    return printed(Print().line_error_um)


@pytest.fixture(scope="session")
def quick(shared_session: MakeSession) -> Session:
    """Fewer views of the laboratory, for what does not depend on their number."""
    return shared_session("quick", 11000.0, SimSettings(seed=3), 5, 6)
