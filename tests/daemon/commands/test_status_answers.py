"""`dcam-ctl status` answers an engineer's questions in their order, and goes on watching."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from subprocess import PIPE

import pytest
from rich.cells import cell_len

from daemon.lock import sole_writer
from daemon.store.records import GapCause
from tests.daemon.commands.conftest import DARK, MINUTE, Ctl, Site
from tests.daemon.commands.terminals import (
    ASCII_LOCALE,
    all_of,
    environment,
    on_pipe,
    on_terminal,
    program,
    started_on,
    terminal,
)
from tests.processes import open_files
from tests.programs import Program
from tests.waiting import PATIENCE_S

WORDS = ["measuring", "last good", "value", "wrong", "complete", "disk"]


def answers(out: str) -> dict[str, str]:
    """The answers by their words; each line is at most 80 columns wide."""
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80, lines
    block = lines[lines.index("") + 1 :]
    block = block[: block.index("")]
    found: dict[str, str] = {}
    for line in block:
        word = line[:11].strip() or list(found)[-1]
        found[word] = f"{found[word]} {line[11:].strip()}" if word in found else line[11:]
    return found


def test_a_site_that_runs_is_answered_in_order(site: Site) -> None:
    with sole_writer(site.state):
        found = answers(site.ctl("status", "--at", "2026-03-01T00:09:30Z").out)
    assert list(found) == WORDS
    assert found["measuring"] == "yes, last slot 30 s ago"
    assert found["last good"] == "30 s ago"
    assert found["value"].startswith("x +0.500 ± 0.100 mm, y -1.250 ± 0.200 mm")
    assert found["wrong"] == "nothing"
    assert found["complete"] == "100.0% of 10 slots in 24 h, 100.0% of 10 slots in 30 d"
    assert " free" in found["disk"]


def dark(site: Site) -> None:
    site.measure(400, DARK)


def camera_lost(site: Site) -> None:
    site.miss(30, GapCause.CAMERA_LOST)


@pytest.mark.parametrize(
    ("happens", "measuring", "wrong"),
    [
        (dark, "no, last slot 1 min ago", "last good value: 6 h 41 min ago"),
        (camera_lost, "no, last slot 31 min ago", "cameras: camera_lost"),
    ],
)
def test_what_is_wrong_is_named_with_what_to_do(
    site: Site, happens: Callable[[Site], None], measuring: str, wrong: str
) -> None:
    happens(site)
    found = answers(site.ctl("status", "--at", site.end.isoformat()).out)
    assert found["measuring"].startswith(measuring)
    assert wrong in found["wrong"]
    assert "systemctl start dcamd" in found["wrong"]


def test_a_site_that_has_never_measured_says_what_to_do(ctl: Ctl, site: Site) -> None:
    site.write(lambda store: None)
    fresh = site.state.parent / "fresh"
    ran = ctl("--config", site.config, "--state", fresh, "status")
    assert ran.code == 3
    assert len(ran.out.splitlines()) == 1
    assert "dcamd" in ran.out


def test_watch_looks_again_until_it_is_interrupted(site: Site) -> None:
    """On a terminal: the screen is cleared, words are coloured, the last verdict is the code."""
    command = program("--config", site.config, "--state", site.state, "status", "--watch", "1")
    ours, its = terminal(80, lines=12)
    with started_on(its, command, TERM="xterm") as watching:
        seen = b""
        while seen.count(b"\x1b[2J") < 3:
            seen += os.read(ours, 65536)
        held = open_files(watching.pid)
        watching.send_signal(signal.SIGINT)
        text = all_of(ours, seen)
        code = watching.wait(PATIENCE_S)
    assert code == 2  # the record is years old
    assert "Traceback" not in text
    assert not [path for path in held if "dcam.db" in path]
    _, first, _ = text.split("\x1b[2J", 2)
    assert 8 < first.count("\n") < 12  # the first line stays on the screen
    assert re.search(r"\x1b\[31m\x1b\[1mmeasuring", text)


def test_colours_are_for_terminals_that_want_them(site: Site) -> None:
    command = program("--config", site.config, "--state", site.state, "status")
    coloured = on_terminal(80, command, TERM="xterm")
    assert "\x1b[31m\x1b[1mmeasuring " in coloured
    assert "\x1b[32m\x1b[1mok " in coloured
    assert "\x1b" not in on_terminal(80, command, TERM="xterm", NO_COLOR="1")
    assert "\x1b" not in on_terminal(80, command, TERM="dumb")
    assert "\x1b" not in site.ctl("status").out


def test_watch_is_for_people(site: Site) -> None:
    for more in ("--json",), ("--at", "24h"):
        ran = site.ctl("status", "--watch", "5", *more)
        assert ran.code == 3  # to a monitoring system every failure is unknown
        assert "leave out --json and --at" in ran.out


def test_a_name_of_any_length_keeps_to_80_columns(site: Site) -> None:
    text = site.config.read_text()
    site.config.write_text(re.sub(r'name = "[^"]*"', f'name = "{"bridge-" * 30}"', text, count=1))
    assert list(answers(site.ctl("status", "--at", site.end.isoformat()).out)) == WORDS


def test_the_value_is_the_last_good_one_though_night_has_come(site: Site) -> None:
    site.measure(200, DARK)
    with sole_writer(site.state):
        found = answers(site.ctl("status", "--at", site.end.isoformat()).out)
    assert found["value"] == (
        "x +0.500 ± 0.100 mm, y -1.250 ± 0.200 mm, 2026-03-01T00:09:00Z "
        "last row: no value (bad: too_dark)"
    )
    assert "dcam-ctl preview" in found["wrong"]


def test_a_camera_that_was_lost_a_moment_ago_measures_nothing(site: Site) -> None:
    site.measure(200)
    site.miss(2, GapCause.CAMERA_LOST)
    with sole_writer(site.state):
        found = answers(site.ctl("status", "--at", site.end.isoformat()).out)
    assert found["measuring"].startswith("no, last slot 3 min ago; camera_lost")
    assert "check power and cables" in found["wrong"]


def test_who_has_started_dcamd_is_not_asked_to_start_it(ctl: Ctl, tmp_path: Path) -> None:
    fresh = Site(tmp_path, ctl)
    fresh.calibrate()
    with sole_writer(fresh.state):
        found = answers(fresh.ctl("status").out)
    assert "measurement: none yet; wait for the first slot" in found["wrong"]
    assert "start dcamd" not in found["wrong"]


@pytest.mark.parametrize("locale", [{}, ASCII_LOCALE], ids=["utf-8", "ascii"])
def test_wide_letters_keep_to_80_columns(site: Site, locale: dict[str, str]) -> None:
    """A sign of two columns, and in ASCII a sigma's sign of three."""
    why = "缆线断了 " * 12 + "± " * 40
    last = site.end
    site.end += MINUTE
    site.write(
        lambda store: store.record_gap(last, last, GapCause.CAMERA_LOST, why, period_s=60) or None
    )
    command = (
        "--config",
        site.config,
        "--state",
        site.state,
        "status",
        "--at",
        site.end.isoformat(),
    )
    out = on_pipe(program(*command), **locale).stdout.decode()
    block = out.splitlines()
    assert block[0].startswith("DCAM ")
    assert "camera_lost" in " ".join(block)
    assert max(map(cell_len, block)) <= 80, block


def test_a_bar_in_a_name_does_not_begin_the_figures(site: Site) -> None:
    text = site.config.read_text()
    site.config.write_text(re.sub(r'name = "[^"]*"', 'name = "east | west"', text, count=1))
    said, figures = site.ctl("status", "--at", site.end.isoformat()).out.split("|")
    assert "east / west" in said.splitlines()[0]
    assert figures.split()[0] == "age=60s"


def test_the_worst_is_told_first(site: Site) -> None:
    site.measure(400, DARK)
    camera_lost(site)
    wrong = answers(site.ctl("status", "--at", site.end.isoformat()).out)["wrong"]
    assert wrong.index("cameras: ") < wrong.index("last good value: ")


def test_watch_on_a_pipe_writes_one_block_after_the_other(site: Site) -> None:
    command = ("--config", site.config, "--state", site.state, "status", "--watch", "1")
    with Program("daemon.ctl", *command, env=environment(), stdout=PIPE) as watching:
        assert watching.stdout is not None
        lines: list[str] = []
        while sum(line.startswith("DCAM ") for line in lines) < 2:
            lines.append(watching.stdout.readline())
        watching.send_signal(signal.SIGINT)
        watching.stdout.read()
        assert watching.wait(PATIENCE_S) == 2
    assert lines[-2] == "\n"
    assert "\x1b" not in "".join(lines)


@pytest.mark.parametrize("columns", [60, 200])
def test_on_a_terminal_every_line_is_wrapped(site: Site, columns: int) -> None:
    command = program("--config", site.config, "--state", site.state, "status")
    lines = on_terminal(columns, command, NO_COLOR="1").splitlines()
    assert max(map(len, lines)) <= min(columns, 80)
    assert lines[0].startswith("DCAM CRITICAL - bench: ")
