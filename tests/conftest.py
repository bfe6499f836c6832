"""For all tests: numerics with one thread, as in our programs. Loaded before anything of numpy."""

import fcntl
import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import daemon  # noqa: F401
from daemon.commands import priority
from daemon.log import configure_log
from tests import compiled_sql, made_database
from tests.drivers.genicam.usb3 import bench

bench.load()  # ahead of Aravis, whichever test loads that

# Programs that the tests start would compile all their code at each start, which takes longer than
# what they are started for.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell that starts the tests in the background has them ignore Ctrl-C, and programs inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

compiled_sql.share()
made_database.share()

# A command at the lowest priority would wait until all other tests have ended.
priority._LOWEST = os.getpriority(os.PRIO_PROCESS, 0)

# As in our programs: structlog's own way draws every local variable of a traceback.
configure_log()

# On a busy computer any example may take long, and the first few of them too.
hypothesis.settings.register_profile(
    "dcam", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("dcam")

TALLY = "tally"
HERE = Path(__file__).parent
LONGEST_FIRST = (
    *("daemon/commands/test_demo.py", "daemon/web/test_page.py", "deploy", "soak", "crash"),
    *("drivers/genicam", "daemon/web/test_figure.py", "system", "faults"),
    *("drivers/heads/test_head_programs.py", "drivers/test_camera_contract.py", "drivers/heads"),
    *("daemon/slots/test_dcamd.py", "daemon/commands/test_calibrate", "daemon/commands"),
    *("docs", "core/calibration", "core/analysis", "daemon/store", "daemon/slots", "daemon"),
    *("studies", "drivers/sim"),
    *("test_house.py", "core/test_", "core/quality", "core/lens", "core"),
)
"""Files that take long, by the beginnings of their names: no process is left alone with one."""
WAITING = (
    *("daemon/readings", "daemon/slots", "daemon/web", "drivers/genicam", "drivers/heads"),
    *("drivers/sensors", "drivers/test_camera_contract.py", "faults", "soak", "system"),
)
"""Whose tests wait half of their time: for a slot, a camera, a browser."""
WAITED = 0.85
"""By this part of the run all of those have begun: at its end fewer processes share the cores."""


COMPILING = pytest.StashKey[subprocess.Popen[bytes]]()

gc.disable()  # until all is imported, of which nothing becomes garbage


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the loops while the processes collect the tests, once for all of them."""
    if session.config.getoption("numprocesses", None):  # not in the processes themselves
        command = [sys.executable, "-m", "tests.all_loops"]
        session.config.stash[COMPILING] = subprocess.Popen(
            command, cwd=HERE.parent, start_new_session=True
        )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Let no process begin before the loops are compiled; a failure shows in their tests."""
    node.config.stash[COMPILING].wait()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """End what compiles, where no test had to wait for it."""
    compiling = session.config.stash.get(COMPILING, None)
    if compiling is not None and compiling.poll() is None:
        os.killpg(compiling.pid, signal.SIGTERM)
        compiling.wait()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Let one process collect ahead of all others: it compiles the tests, which these then read."""
    with Path(__file__).open() as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_SH)
        return (yield)


def pytest_collection_finish() -> None:
    """What is there now stays: no search for garbage looks at it again."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files of long tests first; each process takes the next file when it is free.

    Files whose tests wait lie evenly among the others, so that the cores always have work, and none
    at the end.
    """
    names = [path.relative_to(HERE).as_posix() for path in dict.fromkeys(i.path for i in items)]
    names.sort(key=lambda name: _place(name, LONGEST_FIRST))
    turns = {}
    for waits, until in ((False, 1.0), (True, WAITED)):
        alike = [name for name in names if name.startswith(WAITING) is waits]
        turns |= {HERE / name: until * (k + 0.5) / len(alike) for k, name in enumerate(alike)}
    items.sort(key=lambda item: turns[item.path])


def _place(name: str, beginnings: Sequence[str]) -> int:
    """Which beginning a name has; one more than the last where it has none."""
    found = (k for k, beginning in enumerate(beginnings) if name.startswith(beginning))
    return next(found, len(beginnings))


@pytest.fixture
def tally(record_property: Callable[[str, object], None]) -> Callable[[str], None]:
    """Have a line printed after all tests, also by the process that only collects the results."""
    return lambda line: record_property(TALLY, line)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [
        report for kind in ("passed", "failed") for report in terminalreporter.getreports(kind)
    ]
    for report in reports:
        for name, line in report.user_properties:
            if name == TALLY:
                terminalreporter.write_line(line)
