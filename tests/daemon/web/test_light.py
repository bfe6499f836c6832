"""The page is light: it runs for years beside a measurement, on a small computer."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from core.results import Displacement, Flag, Measurement
from daemon.store.database import open_store
from tests.daemon.store.examples import START, calibration, record, slot

ROOT = Path(__file__).parents[3]
PROGRAM = """
import http.client, sys
from pathlib import Path
from daemon import web_main
from daemon.config.reading import find_installation
from daemon.web.app import build_app
from daemon.web.serving import serving
from daemon.web.settings import settings_of
settings = settings_of(find_installation(Path(sys.argv[1]), Path(sys.argv[2])))
paths = "overview", "series", "spans", "days", "slot/2026-03-01T00:02:00Z", "alarms", "datum"
with serving(build_app(settings), "127.0.0.1", 0, "") as port:
    for path in ("/", "/metrics", *(f"/api/{name}" for name in paths)):
        browser = http.client.HTTPConnection("localhost", port, timeout=300)
        browser.request("GET", path)
        answer = browser.getresponse()
        assert answer.status == 200, (path, answer.read())
print(*sorted({name.partition(".")[0] for name in sys.modules}))
"""
"""What dcam-web has loaded when it has answered."""
VALUE = Displacement(np.array([0.5, 1.0]), np.eye(2) * 0.01, image_mm2=np.eye(2) * 0.0025)
MEASURED = Measurement(Flag.GOOD, (), corrected=VALUE, raw=VALUE, motion=None)
"""Without a fixed target: status names what makes most of its sigma."""
HEAVY = {"numba", "llvmlite", "scipy", "cv2", "sqlalchemy", "alembic", "matplotlib", "reportlab"}


def test_a_page_that_has_answered_has_loaded_no_numerics(tmp_path: Path) -> None:
    """They came in with a type that was imported, and with a sentence of status: 190 MB, not 60."""
    reference = {"utc_s": START.timestamp(), "temperature_c": 20.0, "readings": {}}
    with open_store(tmp_path / "state") as store:
        number = store.add_calibration(calibration({"reference": reference}), activate=True)
        for minute in range(4):
            store.add_measurement(replace(record(slot(minute), MEASURED), calibration_id=number))
    config = str(ROOT / "benchmarks/small.toml")
    command = [sys.executable, "-c", PROGRAM, config, str(tmp_path / "state")]
    environment = {"XDG_CACHE_HOME": str(tmp_path), "PATH": ""}
    ran = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment
    )
    assert ran.returncode == 0, ran.stderr
    loaded = set(ran.stdout.split())
    assert {"starlette", "numpy"} <= loaded
    assert loaded & HEAVY == set()
