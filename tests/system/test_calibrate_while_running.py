"""A running dcamd lends its cameras to `calibrate --pan-tilt`, and then uses its result."""

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from core.results import Flag, Reason
from daemon.errors import StoreError
from daemon.store.database import open_store_readonly
from daemon.store.records import GapCause
from tests.daemon.commands.conftest import SIMULATED
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]


def wait_for_slots(dcamd: subprocess.Popen, state: Path, count: int) -> None:
    """Wait until so many slots have a row."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        assert dcamd.poll() is None, "dcamd ended"
        # The database may be in the making.
        with contextlib.suppress(StoreError), open_store_readonly(state) as store:
            if len(store.measured_slots()) >= count:
                return
        time.sleep(0.3)
    pytest.fail(f"{count} slots did not come")


@contextlib.contextmanager
def killed_at_the_end(dcamd: subprocess.Popen) -> Iterator[None]:
    """A test that fails must not wait for ever for a daemon that nobody has stopped."""
    try:
        yield
    finally:
        dcamd.kill()


def test_slots_before_gap_calibration_slots_after(tmp_path: Path) -> None:
    """Real time for the daemon, stepped time for the head; a slot every two seconds."""
    state = tmp_path / "state"
    of_daemon, of_head = tmp_path / "dcamd.toml", tmp_path / "calibrate.toml"
    of_daemon.write_text(SIMULATED + 'clock = "system"\n[schedule]\nperiod_s = 2\n')
    of_head.write_text(SIMULATED + "[schedule]\nperiod_s = 2\n")
    with (tmp_path / "log").open("w") as log:
        dcamd = subprocess.Popen(
            [sys.executable, "-m", "daemon.main", "--config", of_daemon, "--state", state],
            cwd=ROOT,
            stderr=log,
        )
    with dcamd, killed_at_the_end(dcamd):
        wait_for_slots(dcamd, state, 2)
        calibrated = subprocess.run(
            [
                *(sys.executable, "-m", "daemon.ctl", "--config", of_head, "--state", state),
                *("calibrate", "--pan-tilt"),
            ],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        assert calibrated.returncode == 0, calibrated.stderr
        with open_store_readonly(state) as store:
            before = len(store.measured_slots())
        wait_for_slots(dcamd, state, before + 2)
        dcamd.send_signal(signal.SIGTERM)
        assert dcamd.wait(PATIENCE_S) == 0
    with open_store_readonly(state) as store:
        rows = list(store.measurements())
        gaps = [gap for gap in store.gaps() if gap.cause is GapCause.CALIBRATION]
        assert gaps
        assert all("dcam-ctl calibrate (pid" in gap.detail for gap in gaps)
        first, last = store.accounted()
        coverage = store.coverage(first, last, period_s=2)
        assert coverage.unaccounted == 0
    assert rows[0].measurement.reasons == (Reason.NO_CALIBRATION,)
    assert rows[-1].calibration_id == 1
    assert rows[-1].measurement.flag is not Flag.BAD
