"""What a running dcamd does when it is asked: a look between two slots, another config."""

import json
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from datetime import timedelta
from pathlib import Path

import pytest

from daemon.control.camera_lease import CameraLease
from daemon.control.control_socket import CommandHandlers, ask_daemon, control_socket, paused_daemon
from daemon.errors import DcamError
from daemon.schedule import Schedule
from daemon.slots.snapshot import room_for_look
from drivers.errors import DeviceLostError
from tests.daemon.control.test_control import ask, connected
from tests.daemon.slots.test_dcamd import MARCH, REAL_TIME, Site, unaccounted
from tests.programs import Program, ran
from tests.waiting import PATIENCE_S

LOST = '[[simulation.scenarios]]\nkind = "camera_loss"\nrole = "sub"\nstart_min = 0\n'


@pytest.fixture
def site(tmp_path: Path):
    with closing(Site(tmp_path)) as site:
        site.configure(REAL_TIME)
        yield site


@contextmanager
def running(site: Site) -> Iterator[Program]:
    """A dcamd on the machine's clock, that ends in order."""
    process = site.start()
    try:
        site.notified(r"^STATUS=slot .* done")
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


def ctl(site: Site, *words: str) -> subprocess.CompletedProcess[str]:
    return ran("daemon.ctl", *site.where(), *words)


def test_a_look_beside_dcamd_is_reported_and_not_recorded(site: Site) -> None:
    """Slots far enough apart that a busy computer, too, has room for a look between two."""
    site.configure(REAL_TIME.replace("period_s = 1", "period_s = 8"))
    with running(site) as process:
        ran = ctl(site, "capture", "--json")
        plain = ctl(site, "capture")
        checked = ctl(site, "check", "--hardware", "--json")
        assert process.poll() is None
    seen = json.loads(ran.stdout)
    assert ran.returncode == 1  # there is no calibration to give a value with
    assert seen["measurement"]["reasons"] == ["no_calibration"]
    assert (seen["main"]["width_px"], seen["sub"]["height_px"], seen["pairs"]) == (320, 200, 1)
    assert "no value (bad: no_calibration)" in plain.stdout
    states = {found["name"]: found["state"] for found in json.loads(checked.stdout)["findings"]}
    assert states["main frame"] == states["sub frame"] == "ok"
    with site.store() as store:
        assert unaccounted(store, period_s=8) == 0
        assert store.measured_slots() == site.acknowledged(site.log.read_text())


def test_a_reload_takes_effect_and_a_wrong_config_leaves_the_old_one(site: Site) -> None:
    with running(site) as process:
        site.configure(REAL_TIME + LOST)
        assert ctl(site, "reload").returncode == 0
        site.notified(r"^STATUS=slot .* missed: camera_lost$")
        site.configure(REAL_TIME.replace("period_s = 1", "period_s = -1"))
        refused = ctl(site, "reload")
        assert refused.returncode == 3
        assert "schedule.period_s: must be at least 1, is -1" in refused.stderr
        process.send_signal(signal.SIGHUP)
        while "event=reload_refused" not in site.log.read_text():
            site.notified(r"^STATUS=slot .* missed: camera_lost$")
        site.configure(REAL_TIME)
        process.send_signal(signal.SIGHUP)
        site.notified(r"^STATUS=slot .* done")
    with site.store() as store:
        assert unaccounted(store, period_s=1) == 0
        assert [event.kind for event in store.events(kind="reloaded")] == ["reloaded"] * 2
        assert {gap.cause.value for gap in store.gaps()} <= {"camera_lost", "stopped", "overrun"}


def test_what_a_reload_cannot_change_is_refused_by_its_key(site: Site) -> None:
    with running(site):
        site.configure(REAL_TIME + '[storage]\ndirectory = "/elsewhere"\n')
        refused = ctl(site, "reload")
        assert refused.returncode == 3
        assert "storage.directory: cannot be changed by a reload; restart dcamd" in refused.stderr


def test_without_a_daemon_a_reload_says_so(site: Site) -> None:
    ran = ctl(site, "reload")
    assert ran.returncode == 4
    assert "no dcamd runs" in ran.stderr


@pytest.mark.parametrize(
    ("period_s", "now_s", "ended_s", "has_room"),
    [
        (60, 5, 0, True),
        (60, 1, 0, True),
        (60, 1, -60, False),  # the slot is due and not over
        (60, 1, None, False),
        (60, 5, -60, True),  # it cannot be taken any more
        (60, 31, 0, False),
        (3600, 600, 0, True),
        (3600, 3550, 0, False),
        (10, 4, 0, True),
        (10, 6, 0, False),
    ],
)
def test_a_look_keeps_away_from_slots(period_s, now_s, ended_s, has_room) -> None:
    ended_utc = None if ended_s is None else MARCH + timedelta(seconds=ended_s)
    now_utc = MARCH + timedelta(seconds=now_s)
    assert room_for_look(Schedule(period_s), now_utc, ended_utc) is has_room


def test_a_look_waits_for_the_slot_in_progress_and_a_slot_for_the_look() -> None:
    lease, order = CameraLease(), []
    in_look, may_end = threading.Event(), threading.Event()

    def look() -> None:
        with lease.between_slots(lambda ended_utc: ended_utc == MARCH, PATIENCE_S) as refusal:
            order.append(refusal or "look")
            in_look.set()
            may_end.wait(PATIENCE_S)
            order.append("look is over")

    looking = threading.Thread(target=look)
    with lease.slot(MARCH):
        looking.start()
        order.append("slot")
    assert in_look.wait(PATIENCE_S)
    may_end.set()
    with lease.slot(MARCH + timedelta(minutes=1)):
        order.append("slot")
    looking.join(PATIENCE_S)
    assert order == ["slot", "look", "look is over", "slot"]


def test_a_look_for_which_there_is_never_time_is_refused() -> None:
    with CameraLease().between_slots(lambda _ended_utc: False, 0.01) as refusal:
        assert refusal == "there was no time for it between two slots"


def test_a_look_during_a_pause_is_refused_with_its_reason(station) -> None:
    lease = CameraLease()
    with (
        control_socket(station.state, lease),
        paused_daemon(station.state, "calibration by pid 7"),
        lease.between_slots(lambda _ended_utc: True, 0.0) as refusal,
    ):
        assert refusal == "paused: calibration by pid 7"


@contextmanager
def served(station, capture: Callable[[], dict]) -> Iterator[None]:
    with control_socket(station.state, CameraLease(), CommandHandlers(capture, lambda: None)):
        yield


def test_what_the_daemon_could_not_do_fails_with_its_own_words_and_code(station) -> None:
    def lost() -> dict:
        msg = "sub camera 42: unplugged"
        raise DeviceLostError(msg, "sub")

    with (
        served(station, lost),
        pytest.raises(DcamError, match="sub camera 42: unplugged") as raised,
    ):
        ask_daemon(station.state, "capture")
    assert raised.value.exit_code == 4


def test_a_thousand_who_want_a_look_get_one_and_delay_no_slot(station) -> None:
    looking, may_end = threading.Event(), threading.Event()

    def look() -> dict:
        looking.set()
        may_end.wait(PATIENCE_S)
        return {"measurement": 1}

    runner = station.start()
    request = b'{"command": "capture"}'
    with served(station, look), connected(station.state) as first:
        first.sendall(request + b"\n")
        assert looking.wait(PATIENCE_S)
        for _ in range(1000):
            with connected(station.state) as another:
                answer = ask(another, request)
            assert (answer["ok"], answer["error"]) == (
                *(False, "capture in progress; try again later"),
            )
        runner.run(3)
        assert station.minutes() == [0, 1, 2]
        may_end.set()
        assert json.loads(first.makefile("rb").readline())["look"] == {"measurement": 1}


def test_a_client_that_leaves_or_garbles_its_request_changes_nothing(station) -> None:
    with served(station, lambda: {"measurement": 1}), ExitStack() as open_ones:
        for line in (b'{"command": "capture"', b'{"command": "capt', b'{"command": "reload"}\n'):
            open_ones.enter_context(connected(station.state)).sendall(line)
        with connected(station.state) as leaving:
            leaving.sendall(b'{"command": "capture"}\n')
        station.start().run(2)
        assert station.minutes() == [0, 1]
        with connected(station.state) as asking:
            answer = ask(asking, b'{"command": "capture", "reason": 5}')
            assert answer["error"].startswith("not understood")
            assert ask(asking, b'{"command": "status"}')["ok"]
