"""The page is light: it runs for years beside a measurement, on a small computer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from daemon.store.database import open_store
from tests.daemon.web.site import row

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
HEAVY = {"numba", "llvmlite", "scipy", "cv2", "sqlalchemy", "alembic", "matplotlib", "reportlab"}


def test_a_page_that_has_answered_has_loaded_no_numerics(tmp_path: Path) -> None:
    """Once they came in with a type that was imported: 117 MB instead of 57."""
    with open_store(tmp_path / "state") as store:
        for number in range(3):
            store.add_measurement(row(number))
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
