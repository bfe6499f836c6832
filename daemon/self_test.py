"""Does this installation measure? A simulated rig through calibration and measurement, no state.

`python -m daemon.self_test` is run by the installer, before the service is: it also leaves the
compiled loops in Numba's cache, so that the first slot after an upgrade is not late.
"""

from __future__ import annotations

import csv
import math
import sys
import tempfile
from pathlib import Path

import numpy as np

from core.calibration.calibrate import Method
from daemon.calibration.run import calibrate_frames, views_in
from daemon.commands.demo import SITE
from daemon.config.reading import load_config
from daemon.error_report import report
from daemon.errors import WorkFailedError
from daemon.reprocessing.frames import SetFrames, measure_alone
from daemon.slots.measuring import ActiveCalibration
from daemon.version import VERSION
from drivers.sim.frameset_writer import TRUTH_TABLE, FrameSetPlan, write_frame_set
from drivers.sim.settings import SimSettings

PLAN = FrameSetPlan(intrinsics=6, rig=12, measure=3)
SEED = 3
LIMIT_MM = 0.3
"""A sensor of a third of the pixels, 22 m away, measures to half of this."""


def self_test(directory: Path) -> float:
    """Calibrate and measure in an empty directory; give the largest error, mm.

    Raises WorkFailedError when it is too large or a value is missing; CalibrationError, OSError.
    """
    config = directory / "dcam.toml"
    small = SITE.read_text(encoding="utf-8")
    for whole, third in (("1920", "640"), ("1200", "400"), ("= 5.86", "= 17.58")):
        small = small.replace(whole, third)
    config.write_text(small, encoding="utf-8")
    site = load_config(config).site()
    frames = directory / "set"
    write_frame_set(frames, site, SimSettings(seed=SEED), PLAN)
    run = calibrate_frames(views_in(frames), site, Method.RIGID)
    calibration = ActiveCalibration(1, run.calibration)
    values = [
        measure_alone(slot, site, calibration).corrected for slot in SetFrames((frames,)).slots()
    ]
    errors_mm = [
        np.abs(value.mm - true_mm).max() if value else math.inf
        for value, true_mm in zip(values, _true_mm(frames), strict=True)
    ]
    error_mm = float(max(errors_mm))
    if not error_mm < LIMIT_MM:
        msg = f"self-test: {error_mm:.3f} mm from the truth, the limit is {LIMIT_MM} mm"
        raise WorkFailedError(msg)
    return error_mm


def _true_mm(frames: Path) -> list[tuple[float, float]]:
    with (frames / TRUTH_TABLE).open(newline="", encoding="utf-8") as table:
        rows = [row for row in csv.DictReader(table) if row["role"] == "measure"]
    return [(float(row["x_mm"]), float(row["y_mm"])) for row in rows]


def main() -> int:
    """Run the self-test, say what came of it in one line, and give the exit code."""
    try:
        with tempfile.TemporaryDirectory(prefix="dcam-self-test-") as directory:
            error_mm = self_test(Path(directory))
    except Exception as error:  # noqa: BLE001 - the last place to say it
        return report(error, "dcam", debug="--debug" in sys.argv)
    print(f"dcam: version {VERSION} measures a simulated rig to within {error_mm:.3f} mm")
    return 0


if __name__ == "__main__":
    sys.exit(main())
