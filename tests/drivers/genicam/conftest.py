"""What the tests of GenICam cameras share: a network, the ways to a camera, images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drivers.genicam.gige.bench import gige_network, write_images
from tests.drivers.genicam.gige.kinds import KINDS, Kind, kind_of


@pytest.fixture(scope="module")
def network() -> Iterator[None]:
    with gige_network():
        yield


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest, network: None) -> Kind:
    return kind_of(request.param)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_images(tmp_path_factory.mktemp("images"), 3, seed=2)
