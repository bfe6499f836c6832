"""`dcam-ctl status` answers an engineer's questions in their order, and goes on watching."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.cells import cell_len

from daemon.lock import sole_writer
from daemon.store.records import GapCause
from tests.daemon.commands.conftest import DARK, MINUTE, Ctl, Site
from tests.daemon.commands.terminals import ASCII_LOCALE, ROOT, environment, on_pipe, program
from tests.waiting import PATIENCE_S

WORDS = ["measuring", "last good", "value", "wrong", "complete", "disk"]


def answers(out: str) -> dict[str, str]:
    """The answers by their words; each line is at most 80 columns wide."""
    lines = out.splitlines()
    block = lines[lines.index("") + 1 :]
    block = block[: block.index("")]
    assert max(map(len, block)) <= 80, block
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
    command = ("--config", site.config, "--state", site.state, "status", "--watch", "1")
    ours, its = pty.openpty()
    with subprocess.Popen(
        program(*command), cwd=ROOT, env=environment(TERM="xterm"), stdout=its, stderr=its
    ) as watching:
        os.close(its)
        seen = b""
        while seen.count(b"measuring") < 2:
            seen += os.read(ours, 65536)
        watching.send_signal(signal.SIGINT)
        while True:
            try:
                seen += os.read(ours, 65536)
            except OSError:  # it has ended
                break
        code = watching.wait(PATIENCE_S)
        os.close(ours)
    text = seen.decode()
    assert code == 2  # the record is years old
    assert "Traceback" not in text
    assert text.count("\x1b[2J") >= 2
    assert re.search(r"\x1b\[31m\x1b\[1mmeasuring", text)


def test_colours_are_for_terminals_that_want_them(site: Site) -> None:
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
    first, _, rest = out.partition("\n\n")
    assert first.startswith("DCAM ")
    block = rest.partition("\n\n")[0].splitlines()
    assert "camera_lost" in " ".join(block)
    assert max(map(cell_len, block)) <= 80, block


def test_a_bar_in_a_name_does_not_begin_the_figures(site: Site) -> None:
    text = site.config.read_text()
    site.config.write_text(re.sub(r'name = "[^"]*"', 'name = "east | west"', text, count=1))
    first = site.ctl("status", "--at", site.end.isoformat()).out.splitlines()[0]
    said, figures = first.split("|")
    assert "east / west" in said
    assert figures.split()[0] == "age=60s"
