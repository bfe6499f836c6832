"""Which version of Aravis is loaded, from typelibs as distributions install them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.errors import MissingLibraryError
from drivers.genicam.aravis_device import aravis_version, load_aravis
from tests.drivers.genicam.gige.process import REPOSITORY

SIZE, NSVERSION = 40, 48
"""Where the header of a typelib has its size, and the place of its version (girepository)."""


@pytest.mark.parametrize(
    ("installed", "chosen"),
    [(["0.8"], "0.8"), (["0.10"], "0.10"), (["0.10", "0.8"], "0.8"), (["0.6"], "0.8"), ([], "0.8")],
)
def test_what_is_installed_is_taken_and_the_tested_one_first(
    installed: list[str], chosen: str
) -> None:
    assert aravis_version(installed) == chosen


def typelib_called(version: str, original: Path) -> bytes:
    """A typelib with another version in its header."""
    data = bytearray(original.read_bytes())
    place = len(data)
    data += version.encode() + b"\0"
    data += bytes(-len(data) % 4)
    data[NSVERSION : NSVERSION + 4] = place.to_bytes(4, sys.byteorder)
    data[SIZE : SIZE + 4] = len(data).to_bytes(4, sys.byteorder)
    return bytes(data)


def test_a_computer_with_0_10_alone_loads_it(tmp_path: Path) -> None:
    """With `0.8` off the list that the program knows, as the system's own cannot be hidden."""
    try:
        load_aravis()
    except MissingLibraryError as error:
        pytest.skip(str(error))
    (original,) = Path("/usr/lib").glob("*/girepository-1.0/Aravis-0.8.typelib")
    (tmp_path / "Aravis-0.10.typelib").write_bytes(typelib_called("0.10", original))
    program = (
        "from drivers.genicam import aravis_device\n"
        "aravis_device.ARAVIS_VERSIONS = aravis_device.ARAVIS_VERSIONS[1:]\n"
        "aravis, _ = aravis_device.load_aravis()\n"
        "from gi.repository import GIRepository\n"
        "loaded = GIRepository.Repository.get_default().get_version('Aravis')\n"
        "print(loaded, aravis.get_n_interfaces() > 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=REPOSITORY,
        env={**os.environ, "GI_TYPELIB_PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["0.10", "True"], done.stderr
