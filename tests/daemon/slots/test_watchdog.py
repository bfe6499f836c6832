"""The watchdog is fed by slots that have ended, and a file says what dcamd does now."""

import json
import re
import signal
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from subprocess import PIPE

import pytest

from daemon.control.run_state import read_run_state
from tests.daemon.slots.test_dcamd import MARCH, REAL_TIME, Site
from tests.programs import Program, ran
from tests.waiting import PATIENCE_S

HANGS_AT_ITS_SECOND_SLOT = """
import sys, threading
from daemon import main
from daemon.slots import row_history

measure, calls = row_history.measure, []

def measure_or_hang(*arguments):
    calls.append(arguments)
    if len(calls) == 2:
        print("hangs", flush=True)
        threading.Event().wait()
    return measure(*arguments)

row_history.measure = measure_or_hang
main.main()
"""


HANGS_WHEN_IT_CLOSES = """
import ctypes, sys
from daemon import main
from drivers.sim.cameras import SimulatedCamera

main.CLOSE_LIMIT_S = 0.5
SimulatedCamera.close = lambda _: ctypes.PyDLL(None).sleep(600)  # and keeps the GIL
main.main()
"""


@pytest.fixture
def site(tmp_path: Path):
    with closing(Site(tmp_path)) as site:
        site.configure()
        yield site


def heard(site: Site, process: Program) -> list[str]:
    """All that dcamd sent to its service manager until it ended."""
    said = []
    while not said or said[-1] != "STOPPING=1":
        said.append(site.manager.recv(1000).decode())
    assert process.wait(PATIENCE_S) == 0
    return said


def test_every_slot_feeds_the_watchdog_once_and_nothing_else_does(site: Site, monkeypatch) -> None:
    """Rows and missed slots alike; and the watchdog first learns how long a slot may take."""
    site.configure(
        '[[simulation.scenarios]]\nkind = "camera_loss"\nrole = "sub"\nstart_min = 1\nend_min = 3\n'
    )
    monkeypatch.setenv("WATCHDOG_USEC", "10000000")
    said = heard(site, site.start("--max-slots", "4"))
    begin = said.index("READY=1")
    assert said[begin - 1] == "WATCHDOG_USEC=300000000"
    assert [text for text in said[:begin] if text.startswith("EXTEND_TIMEOUT_USEC=")]
    slots = [text for text in said[begin:] if text.startswith("STATUS=slot")]
    assert len(slots) == 4
    assert sum("camera_lost" in text for text in slots) == 2
    assert {after for text, after in pairwise(said) if text in slots} == {"WATCHDOG=1"}
    assert said.count("WATCHDOG=1") == 4


def test_a_watchdog_that_waits_long_enough_is_left_alone(site: Site, monkeypatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "900000000")
    said = heard(site, site.start("--max-slots", "1"))
    assert not [text for text in said if text.startswith("WATCHDOG_USEC")]


def test_a_slot_that_hangs_feeds_nothing_and_its_pair_is_measured_after_the_abort(
    site: Site, tmp_path: Path
) -> None:
    environ = site.environ() | {"WATCHDOG_USEC": "100000"}  # a timer would feed twenty times
    script = tmp_path / "hangs.py"
    script.write_text(HANGS_AT_ITS_SECOND_SLOT)
    with Program(script, *site.where(), env=environ, stdout=PIPE, stderr=site.log) as process:
        assert process.stdout.readline() == "hangs\n"
        site.notified(r"^WATCHDOG=1$")  # of the first slot
        site.manager.settimeout(1.0)
        with pytest.raises(TimeoutError):
            site.manager.recv(1000)
        process.send_signal(signal.SIGABRT)  # as systemd does it
        assert process.wait(PATIENCE_S) == -signal.SIGABRT
    assert re.search(
        r"Fatal Python error: Aborted.*measure_or_hang", site.log.read_text(), re.DOTALL
    )
    site.manager.settimeout(PATIENCE_S)
    said = heard(site, site.start("--max-slots", "1"))
    late = said.index("STATUS=slot 2026-03-01T00:01:00Z measured late")
    assert said[late + 1] == "WATCHDOG=1"
    with site.store() as store:
        assert len(store.measured_slots()) == 3


def test_a_library_that_hangs_at_the_end_cannot_keep_the_process(
    site: Site, tmp_path: Path
) -> None:
    """It holds even the interpreter's lock, so that nothing of Python runs any more."""
    script = tmp_path / "hangs.py"
    script.write_text(HANGS_WHEN_IT_CLOSES)
    done = ran(script, *site.where(), "--max-slots", 1)
    assert done.returncode == 1
    assert "Timeout (0:00:00" in done.stderr
    with site.store() as store:
        assert store.measured_slots() == {MARCH}


def status(site: Site) -> dict:
    return json.loads(ran("daemon.ctl", *site.where(), "status", "--json").stdout)


def test_status_tells_what_dcamd_says_until_it_is_killed(site: Site) -> None:
    site.configure(
        REAL_TIME + '[[simulation.scenarios]]\nkind = "camera_loss"\nrole = "sub"\nstart_min = 0\n'
    )
    process = site.start()
    site.notified(r"^STATUS=slot .* missed: camera_lost$")
    found = status(site)
    texts = {item["name"]: item["text"] for item in found["items"]}
    assert found["daemon"]["says"]["pid"] == process.pid
    assert texts["daemon"].startswith("running, slot ")
    assert texts["daemon"].endswith("missed camera_lost")
    assert texts["cameras"].startswith("sub lost since slot ")
    assert "in a row without a row (camera_lost: sub camera" in texts["supervision"]
    process.kill()
    process.wait(PATIENCE_S)
    found = status(site)
    assert found["daemon"]["says"] is None
    (text,) = (item["text"] for item in found["items"] if item["name"] == "daemon")
    assert text.startswith("not running, died after")
    assert read_run_state(site.state).pid == process.pid


def test_a_state_file_that_cannot_be_written_is_reported_once_and_costs_no_slot(site: Site) -> None:
    (site.state / "state.json").mkdir(parents=True)
    done = site.run("--max-slots", "3")
    assert done.returncode == 0
    assert done.stderr.count("event=state_not_written") == 1
    with site.store() as store:
        assert store.measured_slots() >= {MARCH}
        assert len(store.measured_slots()) == 3
