"""The systemd unit is one that systemd accepts, with what the daemon relies on."""

import configparser
import shutil
import subprocess
from pathlib import Path

import pytest

UNIT = Path(__file__).parents[2] / "systemd" / "dcamd.service"


def service() -> configparser.SectionProxy:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(UNIT)
    return parser["Service"]


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed")
def test_systemd_has_nothing_to_say_against_the_unit(tmp_path: Path) -> None:
    """The installed program is not here: a stand-in takes its place, nothing else is changed."""
    program = service()["ExecStart"]
    stand_in = tmp_path / "dcamd"
    stand_in.write_text("#!/bin/sh\n")
    stand_in.chmod(0o755)
    unit = tmp_path / "dcamd.service"
    unit.write_text(UNIT.read_text().replace(program, str(stand_in)))

    result = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False
    )

    complaints = [line for line in result.stderr.splitlines() if "dcamd" in line]
    assert (result.returncode, complaints) == (0, [])


def test_unit_says_what_the_daemon_relies_on() -> None:
    unit = service()
    assert unit["Type"] == "notify"
    assert unit["User"] == "dcam"
    assert unit["StateDirectory"] == unit["RuntimeDirectory"] == "dcam"
    assert unit["ExecStart"] == "/opt/dcam/venv/bin/dcamd"
    assert unit["Restart"] == "on-failure"
    assert unit["RestartPreventExitStatus"].split() == ["2", "3"]
