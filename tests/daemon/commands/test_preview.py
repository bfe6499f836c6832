"""`dcam-ctl preview`: pictures and figures of both cameras, on this machine only."""

from __future__ import annotations

import json
import select
import signal
import urllib.error
import urllib.request
from pathlib import Path
from subprocess import PIPE

import cv2
import numpy as np
import pytest

from core.images import GreyImage
from daemon.preview.snapshot import focus_figure
from tests.daemon.commands.conftest import SIMULATED, Ctl
from tests.programs import Program
from tests.waiting import PATIENCE_S


@pytest.fixture
def preview(tmp_path: Path):
    """A running preview that looks once a minute: its address, and the process."""
    (tmp_path / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    words = (
        *("preview", "--port", 0, "--interval", 60),
        *("--config", tmp_path / "dcam.toml", "--state", tmp_path / "s"),
    )
    with Program("daemon.ctl", *words, stdout=PIPE, stderr=PIPE) as process:
        reported = process.stderr.readline()
        address = reported[reported.index("http") :].split()[0]
        yield address, process
        process.kill()


def fetch(url: str, host: str | None = None) -> bytes:
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
        return answer.read()


def test_preview_shows_both_cameras_and_ends_with_ctrl_c(preview) -> None:
    address, process = preview
    shown, _, _ = select.select([process.stdout], [], [], PATIENCE_S)
    assert shown, "a look is shown at once, on a pipe too"
    line = process.stdout.readline()
    assert "main: 5 of 5 discs found" in line
    assert "corners in view found" in line
    assert b"<title>Aim and focus" in fetch(address)
    root = address.removesuffix("aim")
    look = json.loads(fetch(root + "api/aim"))
    assert (look["live"], look["trouble"]) == (True, "")
    main, sub = look["cameras"]["main"], look["cameras"]["sub"]
    assert main["found"] == "5 of 5 discs found"
    assert main["problems"] == []
    assert sum(sub["histogram"]) == 640 * 400
    assert max(abs(shift) for shift in main["off_centre_px"]) < 100
    assert 0 < min(main["room_px"].values()) < max(main["room_px"].values()) < 640
    for name in ("main.jpg", "sub.jpg", "main_detail.png", "sub_detail.png"):
        picture = cv2.imdecode(np.frombuffer(fetch(f"{root}aim/{name}"), np.uint8), 0)
        assert picture.shape == ((400, 640) if "detail" not in name else (400, 480))
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 0


def test_preview_answers_only_this_machine_and_only_what_it_has(preview) -> None:
    address, _ = preview
    with pytest.raises(urllib.error.HTTPError, match="403"):
        fetch(address, host="bridge.example:80")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        fetch(address + "/../../etc/passwd")


def test_a_port_that_is_taken_is_one_line(preview, ctl: Ctl, tmp_path: Path) -> None:
    port = preview[0].removesuffix("/aim").rpartition(":")[2]
    ran = ctl(
        *("preview", "--port", port, "--config", tmp_path / "dcam.toml"),
        *("--state", tmp_path / "other"),
    )
    assert (ran.code, ran.out) == (4, "")
    assert "give another --port" in ran.err


@pytest.mark.parametrize("noise_dn", [0.5, 5.0])
def test_the_focus_figure_is_greatest_in_focus(noise_dn: float) -> None:
    """Noise hides neither which way to turn nor where to stop."""
    rng = np.random.default_rng(1)
    scene = np.kron(rng.integers(60, 180, (30, 40)), np.ones((10, 10))).astype(np.float32)
    figures = []
    for blur_px in (4.0, 2.0, 1.0, 0.5, 1.0, 2.0, 4.0):
        seen = cv2.GaussianBlur(scene, (0, 0), blur_px) + rng.normal(0, noise_dn, scene.shape)
        figures.append(focus_figure(GreyImage(seen.clip(0, 255).astype(np.uint8))))
    assert figures[:4] == sorted(figures[:4])
    assert figures[3:] == sorted(figures[3:], reverse=True)
