"""A real ext4 that fills up, or fails: rows before frames, no slot unaccounted for, no hands."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0
    or shutil.which("mkfs.ext4") is None
    or not Path("/dev/loop-control").exists(),
    reason="needs root, loop devices and mkfs.ext4",
)


def told_by(scenario: str, directory: Path) -> tuple[dict[str, Any], str]:
    """What became of a station, and its log."""
    program = [sys.executable, "-m", "tests.system.failing_disk", scenario, str(directory)]
    result = subprocess.run(
        ["unshare", "-m", *program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    *log, last = result.stdout.splitlines()
    return json.loads(last), "\n".join(log)


def test_full_disk_costs_frames_and_no_row_until_it_has_room_again(tmp_path: Path) -> None:
    told, log = told_by("full", tmp_path)
    assert (told["rows"], told["gaps"]) == (300, [])
    assert told["at first"]["reserve"]
    assert told["without frames"]["reserve"]
    assert told["in the reserve"] == told["in the reserve"] | {"reserve": False}
    assert told["at last"]["reserve"]
    assert set(told["named"]) == {*range(10), *range(200, 300)}
    assert set(told["with_frames"]) | set(told["removed"]) >= set(told["named"])
    wanted = ["frames_not_kept", "reserve_given_up", "reserve_made", "frames_kept_again"]
    assert sorted(k for k in told["events"] if k != "frames_removed") == sorted(wanted)
    for event in ("frames_not_kept", "reserve_given_up", "frames_kept_again"):
        assert log.count(event) == 1, event


def test_disk_that_turns_read_only_costs_a_gap_and_no_restart(tmp_path: Path) -> None:
    """It fails, is taken away, checked and mounted again; the daemon has it back by itself."""
    told, log = told_by("readonly", tmp_path)
    assert told["gaps"] == [[10, 29, "storage_failed"]]
    assert told["rows"] == 20
    assert len(told["with_frames"]) == 20
    assert told["events"][:1] == ["frames_not_kept"]
    assert "frames_kept_again" in told["events"]
    assert log.count("gap_not_recorded") == log.count("frames_not_kept") == 1
    assert told["under_the_mount"] == []
