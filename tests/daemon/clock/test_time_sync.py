"""Whether the clock is disciplined is known where the kernel may not be asked, too."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from daemon.clock.time_sync import LAPSE_S, Synchronisation, kernel_says

NORMAL = "A29FC87B,162.159.200.123,4,1763950000.1,0.0001,0.0,0.0,1.1,0.0,0.3,0.01,0.001,64.2,Normal"
LOST = "00000000,,0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,1.0,1.0,0.0,Not synchronised"


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is all of PATH."""
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


def program(folder: Path, name: str, *, says: str, code: int = 0) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\necho \"$*\" >>{folder}/asked\necho '{says}'\nexit {code}\n")
    path.chmod(0o755)


def locked_in(folder: Path) -> Synchronisation:
    """As the service asks: not the kernel."""
    return Synchronisation(ask_kernel=False, timesync_directory=folder / "timesync")


def test_kernel_says_what_timedatectl_would() -> None:
    """Whatever it is here, the question is allowed and the answer is one."""
    assert kernel_says() in {True, False}


@pytest.mark.parametrize(
    ("age_s", "expected"), [(60.0, True), (LAPSE_S + 60.0, False), (-3600.0, False)]
)
def test_timesyncd_mark_counts_while_it_is_fresh(
    programs: Path, age_s: float, *, expected: bool
) -> None:
    """One of the future was made before the clock was set back."""
    mark = programs / "timesync" / "synchronized"
    mark.parent.mkdir()
    mark.touch()
    os.utime(mark, (time.time() - age_s,) * 2)
    assert locked_in(programs)() is expected


def test_timesyncd_without_a_mark_has_reached_nobody(programs: Path) -> None:
    (programs / "timesync").mkdir()
    assert locked_in(programs)() is False


@pytest.mark.parametrize(("says", "expected"), [(NORMAL, True), (LOST, False)])
def test_chrony_is_asked(programs: Path, says: str, *, expected: bool) -> None:
    program(programs, "chronyc", says=says)
    assert locked_in(programs)() is expected


@pytest.mark.parametrize(("says", "expected"), [("yes", True), ("no", False)])
def test_timedated_is_asked_where_chrony_does_not_answer(
    programs: Path, says: str, *, expected: bool
) -> None:
    """And only once in a while: each question is an entry in the journal."""
    program(programs, "chronyc", says="506 Cannot talk to daemon", code=1)
    program(programs, "timedatectl", says=says)
    ask = locked_in(programs)
    assert [ask() for _ in range(10)] == [expected] * 10
    assert len((programs / "asked").read_text().splitlines()) == 2


def test_nobody_to_ask_is_not_known(programs: Path) -> None:
    assert locked_in(programs)() is None
