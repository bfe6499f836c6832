"""A running dcamd lends its cameras to `calibrate --pan-tilt`, and then uses its result."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path

from core.results import Flag, Reason
from daemon.store.database import open_store_readonly
from daemon.store.records import GapCause
from tests.daemon.commands.conftest import SMALL
from tests.programs import Program, ran
from tests.waiting import PATIENCE_S, wait_for


def wait_for_slots(dcamd: Program, log: Path, count: int) -> None:
    """Wait until so many slots have a row, as dcamd says in its log."""

    def are_there() -> bool:
        assert dcamd.poll() is None, "dcamd ended"
        return slots_done(log) >= count

    wait_for(are_there, f"{count} slots")


def slots_done(log: Path) -> int:
    return log.read_text().count("slot_done")


@contextlib.contextmanager
def killed_at_the_end(dcamd: Program) -> Iterator[None]:
    """A test that fails must not wait for ever for a daemon that nobody has stopped."""
    try:
        yield
    finally:
        dcamd.kill()


def test_slots_before_gap_calibration_slots_after(tmp_path: Path) -> None:
    """Real time for the daemon, stepped time for the head; a slot every two seconds."""
    state = tmp_path / "state"
    of_daemon, of_head = tmp_path / "dcamd.toml", tmp_path / "calibrate.toml"
    of_daemon.write_text(SMALL + 'clock = "system"\n[schedule]\nperiod_s = 2\n')
    of_head.write_text(SMALL + "[schedule]\nperiod_s = 2\n")
    said = tmp_path / "log"
    said.touch()
    dcamd = Program("daemon.main", "--config", of_daemon, "--state", state, stderr=said)
    with dcamd, killed_at_the_end(dcamd):
        wait_for_slots(dcamd, said, 2)
        calibrated = ran(
            "daemon.ctl", "--config", of_head, "--state", state, "calibrate", "--pan-tilt"
        )
        assert calibrated.returncode == 0, calibrated.stderr
        wait_for_slots(dcamd, said, slots_done(said) + 2)
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
