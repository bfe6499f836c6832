"""An alarm is sent once, whatever ends the look; it is acknowledged, silenced, and remembered."""

from __future__ import annotations

import json
import os
import signal
from datetime import timedelta

import pytest

from daemon.alarm import history as history_module
from daemon.alarm.history import alarm_history
from tests import programs
from tests.daemon.alarm.conftest import (
    LOW,
    Program,
    WebServer,
    configure,
    history,
    listed,
    look,
    number_of,
    row,
    words,
)
from tests.daemon.commands.conftest import MINUTE, Site

HOUR = timedelta(hours=1)
KILL = "os.kill(os.getppid(), signal.SIGKILL)"


def look_in_a_process(site: Site) -> int:
    """One look in a process of its own, which may be killed."""
    with started(site) as look:
        return look.wait()


def started(site: Site) -> programs.Program:
    flags = ("--config", site.config, "--state", site.state)
    return programs.Program("daemon.ctl", *flags, "alarm", *words(site))


def low(site: Site, program: Program, more: str = "") -> None:
    configure(site, f"command = {program.command}\n{more}\n{LOW}")
    site.measure(5, row(-11.0))


def of_low(messages: list[str]) -> list[str]:
    return [message for message in messages if "midspan-low: critical" in message]


def test_killed_between_raise_and_send_it_is_sent_after_the_restart_once(
    site: Site, program: Program
) -> None:
    low(site, program)
    program.write("", before=f"{KILL}; sys.exit(1)")  # ends the look before it takes the message
    assert look_in_a_process(site) == -signal.SIGKILL
    assert program.messages() == []
    assert listed(site)["midspan-low"]["state"] == "raised"
    program.write("")
    for _ in range(3):
        look(site)
    assert len(of_low(program.messages())) == 1
    kinds = [one["kind"] for one in history(site) if "midspan-low" in one["name"]]
    assert kinds == ["raised", "sent"]


def test_killed_between_send_and_note_a_copy_says_so_and_bears_the_same_number(
    site: Site, program: Program
) -> None:
    """Nobody can know whether it arrived: it is sent again, and a receiver can tell the copy."""
    low(site, program)
    program.write(KILL)
    assert look_in_a_process(site) == -signal.SIGKILL
    program.write("")
    for _ in range(3):
        look(site)
    first, copy = of_low(program.messages())
    assert number_of(first) == number_of(copy)
    assert "sent before perhaps" in copy
    assert "sent before perhaps" not in first


def test_an_acknowledged_alarm_is_not_repeated_until_it_is_over(
    site: Site, program: Program
) -> None:
    low(site, program, "repeat_h = 1")
    look(site)
    look(site, late=HOUR - MINUTE)
    assert program.titles() == ["dcam bench: CRITICAL"]

    def later(minutes: int, y_mm: float = -11.0) -> None:
        site.measure(minutes, row(y_mm))
        look(site)

    later(60)
    assert program.titles()[1:] == ["dcam bench: still CRITICAL"]
    ran = site.ctl("alarm", "ack", "midspan-low", "--by", "Ana", "--note", "crew on its way")
    assert (ran.code, ran.out) == (0, "acknowledged: midspan-low\n")
    one = listed(site)["midspan-low"]
    assert (one["state"], one["acknowledged_by"], one["note"]) == (
        *("acknowledged", "Ana"),
        "crew on its way",
    )
    for _ in range(3):
        later(61)
    assert len(program.messages()) == 2
    later(5, 0.0)
    assert "midspan-low: cleared" in program.messages()[2]
    later(5)
    assert "midspan-low: critical since" in program.messages()[3]
    assert "acknowledged" not in program.messages()[3]
    assert listed(site)["midspan-low"]["state"] == "raised"


def test_an_alarm_that_becomes_worse_is_not_acknowledged(site: Site, program: Program) -> None:
    configure(site, f'command = {program.command}\nafter_min = 0\nlevel = "warning"')
    look(site, late=5 * MINUTE)
    assert "measurement: warning" in program.messages()[0]
    site.ctl("alarm", "ack", "measurement")
    look(site, late=6 * MINUTE)
    assert len(program.messages()) == 1
    look(site, late=20 * MINUTE)
    assert "measurement: critical" in program.messages()[1]


def test_only_what_is_raised_can_be_acknowledged(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    ran = site.ctl("alarm", "ack", "midspan-lwo")
    assert ran.code == 2
    assert "'midspan-lwo' is not raised; raised now: none" in ran.err


def test_a_silence_ends_by_itself(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    at = words(site)
    ran = site.ctl("alarm", "silence", "1h", "midspan-low", "--note", "load test", *at)
    assert ran.out == "silent until 2026-03-01T01:09:20Z: midspan-low\n"
    site.measure(30, row(-11.0))
    look(site)
    assert program.messages() == []
    assert listed(site)["midspan-low"]["state"] == "raised and silenced"
    assert "load test" in site.ctl("alarm", "list", *words(site)).out
    site.measure(25, row(-11.0))
    look(site)
    assert program.messages() == []
    site.measure(6, row(-11.0))
    look(site)
    (message,) = program.messages()
    assert "midspan-low: critical since 2026-03-01T00:39:20Z" in message


def test_all_are_silenced_for_maintenance_and_what_passed_within_it_is_history(
    site: Site, program: Program
) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    site.ctl("alarm", "silence", "1d", "--by", "Ben", *words(site))
    site.measure(5, row(-11.0))
    look(site)
    site.measure(5, row(0.0))
    look(site)
    assert program.messages() == []
    silenced, raised, cleared = history(site)
    assert (silenced["kind"], silenced["by"], silenced["name"]) == ("silenced", "Ben", "all")
    assert (raised["kind"], cleared["kind"]) == ("raised", "cleared")
    assert site.ctl("alarm", "silence", "end").out == "1 silence ended\n"
    site.measure(5, row(-11.0))
    look(site)
    assert program.titles() == ["dcam bench: CRITICAL"]


def test_a_clock_that_is_set_back_does_not_prolong_a_silence_for_ever(
    site: Site, program: Program
) -> None:
    """The silence was entered a year ahead of the time that is right."""
    configure(site, f"command = {program.command}\n{LOW}")
    site.ctl("alarm", "silence", "2h", "--at", "2027-03-01T00:00:00Z")
    site.measure(5, row(-11.0))
    look(site)
    assert program.titles() == ["dcam bench: CRITICAL"]


@pytest.mark.parametrize("duration", ["2", "h", "two h", "-1h", "100d", "nanh", "infd"])
def test_a_duration_that_is_none_is_refused(site: Site, duration: str) -> None:
    configure(site, "")
    ran = site.ctl("alarm", "silence", "--", duration)
    assert ran.code == 2, ran.out
    assert len(ran.err.strip().splitlines()) == 1


def test_a_name_that_is_none_is_refused_with_those_there_are(site: Site) -> None:
    configure(site, LOW)
    ran = site.ctl("alarm", "silence", "1h", "midspan-hgih")
    assert ran.code == 2
    assert "no alarm is called 'midspan-hgih'; they are: " in ran.err
    assert "midspan-low" in ran.err


def test_a_receiver_that_refuses_is_told_later_and_the_history_says_so_once(
    site: Site, web: WebServer
) -> None:
    configure(site, f'urls = ["{web.url}"]\n{LOW}')
    site.measure(5, row(-11.0))
    web.status = 503
    for _ in range(3):
        assert look(site).code == 4
    web.status = 200
    look(site)
    assert len(web.messages) == 1
    assert [one["kind"] for one in history(site)] == ["raised", "failed", "sent"]


def test_on_a_full_disk_alarms_are_sent_once_and_the_history_goes_on(
    site: Site, program: Program, tmp_path, monkeypatch
) -> None:
    """Directories stand where the files belong: not even root can write there."""
    low(site, program)
    runtime = tmp_path / "dcam-alarm"
    runtime.mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(runtime))
    for name in (".alarm.json.tmp", "alarm-history.jsonl", ".alarm-orders.json.tmp"):
        (site.state / name).mkdir()
    for _ in range(3):
        assert look(site).code == 0
    assert len(program.messages()) == 1
    assert site.ctl("alarm", "ack", "midspan-low").code == 0
    assert [one["kind"] for one in history(site)] == ["raised", "sent", "acknowledged"]


def test_a_damaged_database_keeps_a_raised_alarm_and_is_itself_one(
    site: Site, program: Program
) -> None:
    low(site, program)
    look(site)
    (site.state / "dcam.db").write_bytes(b"nothing" * 1000)
    look(site, late=MINUTE)
    look(site, late=20 * MINUTE)
    assert listed(site)["midspan-low"]["state"] == "raised"
    assert "status: critical since" in program.messages()[-1]


def test_the_history_is_bounded_and_damage_costs_one_line(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_module, "MOST_BYTES", 4000)
    configure(site, "")
    for number in range(60):
        site.ctl("alarm", "silence", "1m", "--by", f"user {number}")
    files = sorted(path.name for path in site.state.glob("alarm-history*"))
    assert files == ["alarm-history.jsonl", "alarm-history.jsonl.1"] or len(files) == 1
    assert sum((site.state / name).stat().st_size for name in files) < 10_000
    newest = alarm_history(site.state)[-1]
    assert newest.by == "user 59"
    path = site.state / "alarm-history.jsonl"
    with path.open("ab") as file:
        file.write(b'{"time_utc": "2026-0')  # a power cut
    site.ctl("alarm", "silence", "1m", "--by", "after")
    assert alarm_history(site.state)[-1].by == "after"


def test_status_says_what_is_armed_and_raised(site: Site, program: Program) -> None:
    low(site, program)
    said = {one["name"]: one for one in json.loads(site.status().out)["items"]}
    assert said["alarms"]["level"] == "ok"
    assert said["alarms"]["text"].endswith("armed")
    look(site)
    said = {one["name"]: one for one in json.loads(site.status().out)["items"]}
    assert said["alarms"]["level"] == "critical"
    assert "midspan-low raised" in said["alarms"]["text"]
    site.ctl("alarm", "ack", "midspan-low")
    said = {one["name"]: one for one in json.loads(site.status().out)["items"]}
    assert said["alarms"]["level"] == "ok"
    assert "midspan-low acknowledged" in said["alarms"]["text"]


def test_two_looks_at_the_same_time_send_one_message(site: Site, program: Program) -> None:
    """The first one waits in its receiver while the second one looks."""
    low(site, program)
    begun, go = site.state / "begun", site.state / "go"
    os.mkfifo(begun)
    os.mkfifo(go)
    program.write(f"open({str(begun)!r}, 'w').write('x'); open({str(go)!r}).read()")
    with started(site) as first:
        begun.read_text()
        ran = look(site)
        assert "another look is in progress" in ran.out
        go.write_text("x")
        assert first.wait() == 0
    assert len(program.messages()) == 1
