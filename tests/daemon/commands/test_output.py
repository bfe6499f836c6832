"""How commands talk: nothing is cut, any locale is survived, long work is heard of on a pipe."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import pytest

from daemon.store.records import GapCause
from tests.daemon.commands.conftest import SIMULATED, START, Site
from tests.daemon.commands.terminals import (
    ASCII_LOCALE,
    ROOT,
    environment,
    on_pipe,
    on_terminal,
    program,
    several,
)

DETAIL = (
    "main camera: no frame within 2 s since 2026-03-01T00:09:58Z; look at its cable, its power "
    "supply and the switch, then dcam-ctl check --hardware"
)


@pytest.fixture
def gappy(site: Site) -> Site:
    """A site with gaps of long causes and long details."""
    for cause in (GapCause.STORAGE_FAILED, GapCause.CAPTURE_FAILED, GapCause.POWER_LOSS):
        first = site.end
        site.end += timedelta(minutes=5)
        last = site.end - timedelta(minutes=1)
        site.write(
            lambda store, first=first, last=last, cause=cause: (
                store.record_gap(first, last, cause, DETAIL, period_s=60) or None
            )
        )
        site.measure(2)
    return site


def words_of(site: Site, command: str) -> list[object]:
    """A command line that prints a table, always the same one."""
    more = {
        "status": ["--at", (START + timedelta(days=1)).isoformat()],
        "target": ["--output", site.config.parent],
    }
    return ["--config", site.config, "--state", site.state, command, *more.get(command, [])]


def test_a_terminal_shows_every_word_that_a_pipe_gets(gappy: Site) -> None:
    """Times, causes and what to do are whole; only a word wider than its column is folded."""
    commands = several(
        *(words_of(gappy, name) for name in ("gaps", "status", "check", "plan", "target"))
    )
    piped = without_sizes(on_pipe(commands).stdout.decode())
    for columns in (80, 60):
        shown = without_sizes(on_terminal(columns, commands))
        assert piped.count("== exit code") == shown.count("== exit code") == 5
        unbroken = "".join(shown.split())
        missing = set(piped.split()) - set(shown.split())
        assert [word for word in missing if len(word) < 24 or word not in unbroken] == [], shown
        assert "…" not in shown
        wide = [line for line in shown.splitlines() if len(line) > columns]
        assert set(wide) <= set(piped.splitlines()), "only what is no table may be wider"


def without_sizes(text: str) -> str:
    """Without the free space of the disk, and how long it lasts: others use it meanwhile."""
    sizes = r"disk_free=\d+B|[\d.]+ GB|(free_bytes|_bytes\S*) \S+|after\s+[\d.]+\s+days"
    return re.sub(sizes, "SIZE", text)


CLEAR = "\x1b[2J\x1b]0;owned\x07\x9b31m"


@pytest.mark.parametrize("words", [["gaps"], ["gaps", "--json"], ["status"], ["check"]])
def test_names_and_reasons_reach_a_terminal_as_text(site: Site, words: list[str]) -> None:
    """A camera's name and a library's words may hold what a terminal obeys."""
    escaped = CLEAR.encode("unicode_escape").decode().replace("\\x", "\\u00")
    site.config.write_text(SIMULATED.replace('"bench"', f'"bench {escaped}"'))
    slot, cause = site.end, GapCause.STORAGE_FAILED
    site.write(lambda store: store.record_gap(slot, slot, cause, CLEAR, period_s=60) or None)
    ran = site.ctl(*words)
    assert "owned" in ran.out
    assert not [sign for sign in ran.out + ran.err if not sign.isprintable() and sign != "\n"]


def test_on_a_pipe_a_gap_is_one_line_however_long(gappy: Site) -> None:
    out = on_pipe(program(*words_of(gappy, "gaps")), COLUMNS="60").stdout.decode()
    lines = out.splitlines()
    assert len(lines) == 5
    assert all(line.endswith(DETAIL) for line in lines[1:4])
    assert lines[1].split()[:4] == [
        *("2026-03-01T00:10:00Z", "2026-03-01T00:14:00Z", "5", "storage_failed")
    ]
    assert not any(line != line.rstrip() for line in lines)


def test_a_locale_of_ascii_gets_readable_text_and_exact_data(site: Site) -> None:
    """`+/-` for the sign of a sigma, a letter without its accent; JSON keeps all."""
    text = site.config.read_text()
    name = next(line for line in text.splitlines() if line.startswith("name = "))
    site.config.write_text(text.replace(name, 'name = "Brücke 桥"'))
    words = words_of(site, "status")
    ran = on_pipe(several(words, [*words, "--json"]), **ASCII_LOCALE)
    assert ran.stderr == b""
    reported, data = ran.stdout.split(b"== exit code 2\n")[:2]
    assert b"x +0.500 +/- 0.100 mm" in reported
    assert b"Brucke \\u6865" in reported
    assert json.loads(data)["site"] == "Brücke 桥"
    shown = on_terminal(100, program(*words), **ASCII_LOCALE)
    assert "x +0.500 +/- 0.100 mm" in " ".join(shown.split())


def test_a_locale_of_ascii_gets_a_readable_error(site: Site) -> None:
    ran = on_pipe(program("--config", "Brücke±.toml", "check"), **ASCII_LOCALE)
    assert ran.returncode == 3
    assert b"Traceback" not in ran.stderr
    assert "Brücke±.toml: no such file".encode() in ran.stderr, "a file's name is its bytes"


def whole_lines(text: str) -> list[str]:
    """The words of all lines but those that are cut to the width, each in its own place."""
    return " ".join(line for line in text.splitlines() if not line.endswith(" ...")).split()


def test_commands_say_in_ascii_what_they_say_in_utf_8(site: Site) -> None:
    names = ("status", "export", "metrics", "gaps", "verify", "plan", "check", "capture")
    commands = several(*(words_of(site, name) for name in names))
    ran, plain = on_pipe(commands), on_pipe(commands, **ASCII_LOCALE)
    assert b"Traceback" not in plain.stderr
    assert plain.stdout.isascii()
    expected, given = (
        [
            whole_lines(one)  # a line breaks elsewhere where a sign takes three columns
            for one in without_sizes(done.stdout.decode().replace("±", "+/-")).split("== exit code")
        ]
        for done in (ran, plain)
    )
    assert given[:-2] == expected[:-2], "all but capture, which measures another pair"
    assert given[-1] == expected[-1]


def test_the_log_of_dcamd_is_written_in_a_locale_of_ascii(tmp_path: Path) -> None:
    """Each slot's line, and the path of a state that has a sign of its own."""
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    words = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "Straße", "--max-slots", 1)
    ran = on_pipe(program(*words, module="daemon.main"), **ASCII_LOCALE)
    assert ran.returncode == 0, ran.stderr
    assert b"event=slot_" in ran.stderr
    assert b"Logging error" not in ran.stderr
    assert b"Traceback" not in ran.stderr


PROGRESS = """
import sys
from daemon.commands import output
output.LINE_PERIOD_S = float(sys.argv[1])
with output.progress(21, "taking views", each=sys.argv[2] == "each") as steps:
    steps.next("position 1 of 20")
    steps.next("position 2 of 20")
    sys.stdin.readline()
    steps.begin("rows")
    steps.at(300, 4000)
    sys.stdin.readline()
    steps.begin("fitting")
    sys.stdin.readline()
"""


def running(period_s: float, which: str) -> subprocess.Popen[str]:
    """A long work that goes on when it gets a line, with stderr on a pipe."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRESS, str(period_s), which],
        cwd=ROOT,
        env=environment(),
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_long_work_says_on_a_pipe_now_and_then_how_far_it_is() -> None:
    """Also while one step takes long: that is when somebody asks whether it hangs."""
    with running(0.05, "now and then") as work:
        seen = [work.stderr.readline()]
        while "position 2" not in seen[-1]:
            seen.append(work.stderr.readline())
        assert seen[-1] == "dcam-ctl: taking views, 2 of 21: position 2 of 20\n"
        assert work.stderr.readline() == seen[-1], "it is still at it"
        print(file=work.stdin, flush=True)
        while "300" not in seen[-1]:
            seen.append(work.stderr.readline())
        assert seen[-1] == "dcam-ctl: rows, 300 of 4000\n"
        print(file=work.stdin, flush=True)
        while "fitting" not in seen[-1]:
            seen.append(work.stderr.readline())
        first = seconds_so_far(seen[-1])
        while seconds_so_far(seen[-1]) == first:
            seen.append(work.stderr.readline())
        assert seconds_so_far(seen[-1]) > first
        work.communicate("\n")
        assert work.returncode == 0
    assert not any("\r" in line for line in seen)


def seconds_so_far(line: str) -> int:
    """How long the fit has taken, which counts nothing."""
    told = re.fullmatch(r"dcam-ctl: fitting, (\d+) s so far\n", line)
    assert told is not None, line
    return int(told[1])


def test_each_named_step_has_a_line_where_that_is_wanted_and_short_work_is_silent() -> None:
    with running(3600.0, "each") as work:
        _, err = work.communicate("\n\n\n")
    assert err.splitlines() == [
        "dcam-ctl: taking views, 1 of 21: position 1 of 20",
        "dcam-ctl: taking views, 2 of 21: position 2 of 20",
    ]
    with running(3600.0, "now and then") as work:
        assert work.communicate("\n\n\n")[1] == ""
