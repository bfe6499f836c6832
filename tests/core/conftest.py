"""Calibrated sites, made once for all tests of the core."""

from __future__ import annotations

import pytest

from core.calibration.calibrate import Method
from drivers.sim.settings import SimSettings
from tests.core.sessions import Session, session


@pytest.fixture(scope="session")
def lab() -> Session:
    """11 m: twelve lens views, twelve head positions."""
    return session(11000.0, SimSettings(seed=3), lens=12, rig=12)


@pytest.fixture(scope="session")
def field() -> Session:
    """22 m, another rig."""
    return session(22000.0, SimSettings(seed=6), lens=12, rig=12)


@pytest.fixture(scope="session")
def paper(lab: Session) -> Session:
    """The laboratory's views by the paper's method."""
    return lab.calibrated_again(Method.PAPER)


@pytest.fixture(scope="session")
def quick() -> Session:
    """Fewer views of the laboratory, for what does not depend on their number."""
    return session(11000.0, SimSettings(seed=3), lens=5, rig=6)
