"""`dcam-ctl alarm` tells real receivers: once, again while it lasts, and when it is over."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from daemon.alarm import receivers
from daemon.clock.machine import read_boot_id, uptime_s
from daemon.control.run_state import RunState, write_run_state
from daemon.lock import sole_writer
from daemon.store.records import Mark
from tests.daemon.alarm.conftest import Program, WebServer, configure
from tests.daemon.commands.conftest import GOOD, MINUTE, START, Ran, Site


@pytest.fixture
def inbox(site: Site, program: Program) -> Program:
    """The site tells a program, which accepts."""
    configure(site, f"command = {program.command}")
    return program


def test_a_test_without_anybody_to_tell_fails_and_says_what_to_set(site: Site) -> None:
    ran = site.ctl("alarm", "--test")
    assert ran.code == 3
    assert f"{site.config}: [alarm] names nobody to tell; set its urls" in ran.err
    assert site.ctl("alarm").code == 0  # the timer of a site that wants no alarm does not fail


def look(site: Site, *words: object, late: timedelta = timedelta(0), running: bool = True) -> Ran:
    """One look after the newest row, beside a dcamd that runs, or none."""
    at = (site.end - MINUTE + late).isoformat()
    if not running:
        return site.ctl("alarm", "--at", at, *words)
    with sole_writer(site.state):
        return site.ctl("alarm", "--at", at, *words)


def die(site: Site) -> None:
    """Leave what a dcamd leaves that did not stop in order."""
    site.write(lambda store: store.set_mark(Mark.HEARTBEAT_UTC, START.isoformat()))


def test_without_receivers_one_line_and_all_is_well(site: Site) -> None:
    ran = site.ctl("alarm")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out == "nobody to tell: [alarm] in the config names neither urls nor a command\n"
    assert not (site.state / "alarm.json").exists()


def test_a_dead_daemon_is_reported_once_again_while_it_lasts_and_when_it_is_over(
    site: Site, inbox: Program
) -> None:
    configure(site, f"command = {inbox.command}\nrepeat_h = 0.5")
    die(site)
    assert look(site, running=False).code == 0  # 00:09
    site.measure(14)
    look(site, running=False)
    assert inbox.messages() == []
    site.measure(1)
    look(site, running=False)  # 00:24
    (message,) = inbox.messages()
    headline, line, _ = message.splitlines()
    assert headline == "dcam bench: CRITICAL"
    reported = (
        "daemon: critical since 2026-03-01T00:09:00Z (15 min): not running, died after 2026-03-0"
    )
    assert line.startswith(reported)
    for minutes in (5, 24):
        site.measure(minutes)
        look(site, running=False)
    assert len(inbox.messages()) == 1
    site.measure(1)
    look(site, running=False)  # 00:54
    assert inbox.titles()[1:] == ["dcam bench: still CRITICAL"]
    site.measure(1)
    for _ in range(2):
        ran = look(site)
        assert (ran.code, ran.out) == (0, "nothing is wrong\n")
    assert inbox.titles()[2:] == ["dcam bench: all well again"]


def test_a_daemon_that_hangs_and_data_that_stopped_are_reported(site: Site, inbox: Program) -> None:
    state = RunState(os.getpid(), read_boot_id(), "1.0", "", "running", patience_s=300.0)
    write_run_state(site.state, replace(state, reported_s=uptime_s() - 3600))
    for late in (30 * MINUTE, 45 * MINUTE):
        look(site, late=late)
    (message,) = inbox.messages()
    assert "daemon: critical since" in message
    assert "hangs: no slot has ended for 1 h" in message
    assert "measurement: critical since" in message


def test_what_passes_in_time_is_not_reported(site: Site, inbox: Program) -> None:
    die(site)
    look(site, running=False)
    site.measure(10)
    look(site)
    site.measure(10)
    look(site, running=False)
    assert inbox.messages() == []


def test_a_warning_is_reported_only_where_the_config_says_so_and_once_more_if_it_gets_worse(
    site: Site, inbox: Program
) -> None:
    site.measure(200, GOOD, frame=None)  # a warning
    look(site)
    look(site, late=16 * MINUTE - MINUTE)
    assert inbox.messages() == []
    configure(site, f'command = {inbox.command}\nlevel = "warning"\nafter_min = 0')
    look(site)
    look(site)
    assert inbox.titles() == ["dcam bench: WARNING"]
    look(site, late=5 * MINUTE)  # the last row is late: another warning
    look(site, late=30 * MINUTE)  # lost: critical
    assert inbox.titles()[1:] == ["dcam bench: WARNING", "dcam bench: CRITICAL"]


def test_a_message_that_is_refused_is_reported_on_stderr_and_sent_at_the_next_look(
    site: Site, inbox: Program
) -> None:
    configure(site, f"command = {inbox.command}\nafter_min = 0")
    die(site)
    inbox.write("", before="sys.exit('no carrier')")
    for _ in range(2):
        ran = look(site, running=False)
        assert ran.code == 4
        (line,) = ran.err.splitlines()
        assert "alarm.command did not accept 'dcam bench: CRITICAL'" in line
        assert line.endswith("ended with code 1: no carrier")
    inbox.write("")
    for _ in range(2):
        assert look(site, running=False).code == 0
    assert inbox.titles() == ["dcam bench: CRITICAL"]


def test_of_two_receivers_only_the_one_that_refused_is_notified_again(
    site: Site, inbox: Program, web: WebServer
) -> None:
    configure(site, f'urls = ["{web.url}"]\ncommand = {inbox.command}\nafter_min = 0')
    die(site)
    web.status = 503
    assert look(site, running=False).code == 4
    web.status = 200
    assert look(site, running=False).code == 0
    assert inbox.titles() == ["dcam bench: CRITICAL"]
    assert web.titles() == ["dcam bench: CRITICAL"]


def test_a_broken_memory_is_reported_and_begun_again(site: Site, inbox: Program) -> None:
    configure(site, f"command = {inbox.command}\nafter_min = 0")
    die(site)
    for garbage in (b"", b"{", b"[]", b'{"since": {"daemon": 7}}', b"\xff"):
        (site.state / "alarm.json").write_bytes(garbage)
        ran = look(site, running=False)
        assert ran.code == 0
        assert f"{site.state / 'alarm.json'}: damaged: begun again from nothing" in ran.err
    assert len(inbox.messages()) == 5


def test_a_disk_that_refuses_the_memory_is_reported_once_per_boot(
    site: Site, inbox: Program, tmp_path: Path, monkeypatch
) -> None:
    """A directory stands where the memory belongs: not even root can write a file over it."""
    configure(site, f"command = {inbox.command}\nafter_min = 0")
    die(site)
    runtime = tmp_path / "dcam-alarm"
    runtime.mkdir()
    in_the_way = site.state / ".alarm.json.tmp"
    in_the_way.mkdir()
    assert look(site, running=False).code == 4
    assert look(site, running=False).code == 4
    assert len(inbox.messages()) == 2
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(runtime))
    for _ in range(3):
        look(site, running=False)
    assert len(inbox.messages()) == 3
    in_the_way.rmdir()
    site.measure(1)
    look(site)
    assert inbox.titles()[-1] == "dcam bench: all well again"
    assert list(runtime.iterdir()) == []


def test_a_clock_that_is_set_back_neither_silences_nor_repeats(site: Site, inbox: Program) -> None:
    die(site)
    look(site, running=False)
    site.measure(15)
    look(site, running=False)
    assert len(inbox.messages()) == 1
    for minutes in (300, 299, 301):
        look(site, late=-minutes * MINUTE, running=False)
    assert "measurement: critical" not in inbox.messages()[-1]
    look(site, late=-280 * MINUTE, running=False)
    assert "is the clock wrong?" in inbox.messages()[-1]
    assert len(inbox.messages()) == 2


@pytest.mark.parametrize(
    ("damage", "reported"),
    [
        (lambda site: (site.state / "dcam.db").write_bytes(b"nothing" * 1000), "critical since"),
        (lambda site: (site.state / "dcam.db").unlink(), "no database"),
        (lambda site: configure_wrongly(site, "= 8.0", "= -8.0"), "diameter_mm"),
        (lambda site: configure_wrongly(site, "kind =", "kind = ="), "not valid TOML"),
    ],
)
def test_a_site_of_which_nothing_can_be_known_is_reported(
    site: Site, inbox: Program, damage: Callable[[Site], object], reported: str
) -> None:
    """A database that is none, a config that is wrong: its [alarm] is read all the same."""
    damage(site)
    look(site)
    ran = look(site, late=15 * MINUTE)
    assert ran.code == 0, ran.err
    (message,) = inbox.messages()
    assert message.splitlines()[1].startswith("status: ")
    assert reported in message


def configure_wrongly(site: Site, right: str, wrong: str) -> None:
    site.config.write_text(site.config.read_text().replace(right, wrong))


def test_an_alarm_section_that_is_wrong_is_a_config_error(site: Site) -> None:
    configure(site, 'urls = ["json://localhost"]\nlevel = "loud"')
    ran = look(site)
    assert (ran.code, ran.out) == (3, "")
    assert "alarm.level" in ran.err


def test_what_was_reported_is_still_known_while_nothing_can_be(site: Site, inbox: Program) -> None:
    """A config that is wrong for a while is reported; the dead daemon not once more after it."""
    configure(site, f"command = {inbox.command}\nafter_min = 0")
    die(site)
    look(site, running=False)
    right = site.config.read_text()
    configure_wrongly(site, "= 8.0", "= -8.0")
    look(site, running=False)
    site.config.write_text(right)
    look(site, running=False)
    assert inbox.titles() == [
        "dcam bench: CRITICAL",
        "dcam bench: UNKNOWN",
        "dcam bench: cleared status",
    ]


def test_a_trial_tells_who_accepted_it_whatever_the_site_is_like(
    site: Site, inbox: Program, web: WebServer
) -> None:
    configure(site, f'urls = ["{web.url}", "nonsense://x"]\ncommand = {inbox.command}')
    ran = site.ctl("alarm", "--test")
    assert ran.code == 4
    first, second, third = ran.err.splitlines()
    assert first.endswith("alarm.urls[0] (json) accepted 'dcam bench: test'")
    assert "alarm.urls[1] (nonsense) did not accept" in second
    assert third.endswith("alarm.command accepted 'dcam bench: test'")
    (message,) = web.messages
    assert message["title"] == "dcam bench: test"
    assert "Nothing is wrong" in message["message"]
    assert inbox.titles() == ["dcam bench: test"]
    configure(site, f"command = {inbox.command}")
    assert site.ctl("alarm", "--test").code == 0


def test_a_failure_names_its_cause_and_no_secret(site: Site, web: WebServer) -> None:
    configure(site, f'urls = ["{web.url}/?:token=hunter2"]')
    web.status = 503
    ran = site.ctl("alarm", "--test")
    (line,) = ran.err.splitlines()
    assert "503" in line
    assert "hunter2" not in line


def test_a_program_that_repeats_what_it_was_called_with_is_not_quoted(
    site: Site, tmp_path: Path
) -> None:
    script = tmp_path / "sms.py"
    script.write_text("import sys; sys.exit(f'no carrier {sys.argv} pass {sys.argv[2][6:]}')")
    words = [sys.executable, str(script), "+491701234567", "--pin=hunter2"]
    configure(site, f"command = {json.dumps(words)}")
    ran = site.ctl("alarm", "--test")
    assert ran.code == 4
    assert "ended with code 1: no carrier" in ran.err
    for value in (*words, "hunter2"):
        assert value not in ran.err


def test_an_address_that_apprise_repeats_is_not_quoted(site: Site, monkeypatch) -> None:
    apprise = pytest.importorskip("apprise")

    def complain(self, **_words: object) -> bool:
        receivers.logging.getLogger("apprise").warning("pier3:hunter2 at box.example: gone")
        return False

    monkeypatch.setattr(apprise.Apprise, "notify", complain)
    configure(site, 'urls = ["json://pier3:hunter2@box.example/token"]')
    ran = site.ctl("alarm", "--test")
    assert ran.code == 4
    assert ran.err.endswith("...:... at ...: gone\n")


def test_whatever_apprise_raises_costs_the_message_only(site: Site, monkeypatch) -> None:
    apprise = pytest.importorskip("apprise")

    def burst(self, **_words: object) -> bool:
        msg = "json://hunter2"
        raise ValueError(msg)

    monkeypatch.setattr(apprise.Apprise, "notify", burst)
    configure(site, 'urls = ["json://hunter2"]')
    ran = site.ctl("alarm", "--test")
    assert ran.code == 4
    assert ran.err.endswith("Apprise failed: ValueError\n")


def test_a_program_that_hangs_is_ended_with_what_it_started(
    site: Site, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(receivers, "DEADLINE_S", 0.5)
    alive = tmp_path / "alive"
    os.mkfifo(alive)
    script = f"sleep 600 > {alive} & sleep 600 > {alive}"
    configure(site, f"command = {json.dumps(['sh', '-c', script])}")
    reader = os.open(alive, os.O_RDONLY | os.O_NONBLOCK)
    ran = site.ctl("alarm", "--test")
    assert ran.code == 4
    assert "did not accept 'dcam bench: test': not done in" in ran.err
    os.set_blocking(reader, True)
    assert os.read(reader, 1) == b""  # the last writer is gone
    os.close(reader)


def test_without_apprise_one_line_says_how_to_get_it(site: Site, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "apprise", None)
    configure(site, 'urls = ["json://localhost"]')
    ran = site.ctl("alarm", "--test")
    assert ran.code == 4
    assert re.search(r"apprise is not installed; \S+ -m pip install 'apprise[<>=,.0-9]+'$", ran.err)
