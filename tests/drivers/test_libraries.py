"""A library that is missing: the advice can be followed in the installation that gives it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from drivers.errors import MissingLibraryError
from drivers.libraries import require_library

ROOT = Path(__file__).parents[2]
ASK = (
    "import sys; sys.modules[sys.argv[1]] = None\n"
    "from drivers.libraries import missing_library\n"
    "print(missing_library(*sys.argv[1:]))"
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment without a pip of its own, as ours in /opt/dcam are."""
    place = tmp_path_factory.mktemp("installed") / "venv"
    make = [sys.executable, "-m", "venv", "--without-pip", place]
    subprocess.run(make, check=True)
    return place / "bin" / "python"


def asked(python: Path, *words: str) -> str:
    """The advice that this Python gives; it sees our packages, pip among them, as Debian's."""
    path = os.pathsep.join([str(ROOT), sysconfig.get_path("purelib")])
    environment = os.environ | {"PYTHONPATH": path}
    command = [python, "-c", ASK, *words]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, env=environment
    ).stdout.strip()


def test_an_installation_says_where_parquet_can_be_had(installed: Path) -> None:
    said = asked(installed, "pyarrow", "Parquet")
    assert said.startswith("no Parquet: pyarrow is not installed; neither make install nor")
    assert "dcam-ctl backup" in said
    assert "pip" not in said


def test_an_installation_that_lacks_what_it_brings_is_installed_again(installed: Path) -> None:
    said = asked(installed, "paho", "MQTT", "paho-mqtt")
    assert said.endswith("install dcam again (make install, or the package)")
    assert "pip" not in said


def test_an_environment_with_pip_is_given_a_command_that_pip_takes() -> None:
    said = asked(Path(sys.executable), "paho", "MQTT", "paho-mqtt")
    assert said.startswith("no MQTT: paho-mqtt is not installed; ")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (wanted,) = extras["optional-dependencies"]["mqtt"]
    command = re.search(r"; (\S+) -m pip install '(.+)'$", said)
    assert command, said
    assert command[1] == sys.executable
    assert Requirement(command[2]) == Requirement(wanted)


def test_a_camera_library_that_does_not_load_is_advised_on_for_this_installation(
    installed: Path,
) -> None:
    """`harvesters` comes with dcam, so that one without it is not whole; pip is not there."""
    ask = (
        "import sys; sys.modules['genicam'] = None\n"
        "from drivers.genicam.gentl_device import load_harvesters\n"
        "load_harvesters()"
    )
    path = os.pathsep.join([str(ROOT), sysconfig.get_path("purelib")])
    environment = os.environ | {"PYTHONPATH": path}
    command = [installed, "-c", ask]
    said = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    last = said.stderr.splitlines()[-1]
    assert "harvesters cannot be loaded (import of genicam halted" in last
    assert last.endswith("install dcam again (make install, or the package)")


def test_what_is_there_is_not_missed() -> None:
    require_library("numpy", "number")
    with pytest.raises(MissingLibraryError, match="no chart: no_such_library is not installed"):
        require_library("no_such_library", "chart")
