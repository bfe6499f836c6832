"""`dcam-ctl check --hardware --long` on two USB3 cameras that do what real ones may."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from daemon.checks import long_look
from tests.daemon.commands.conftest import Ctl
from tests.drivers.genicam.gige.bench import gige_network, running
from tests.drivers.genicam.usb3.bench import Usb3Process, require_bus
from tests.laboratory import laboratory


@pytest.fixture(autouse=True)
def network() -> Iterator[None]:
    require_bus()
    with gige_network():
        yield


def test_the_long_look_reports_what_only_the_camera_knows(
    ctl: Ctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(long_look, "SPAN_S", 3.0)
    monkeypatch.setattr(long_look, "N_PAIRS", 6)
    (tmp_path / "dcam.toml").write_text(laboratory(320, "aravis"))
    image = tmp_path / "dim.png"
    cv2.imwrite(str(image), np.tile(np.arange(320, dtype=np.uint8) // 8, (200, 1)))
    main = Usb3Process("1", "15290000", [image], ["--left", "b100=1"])
    sub = Usb3Process("2", "15290001", [image])
    with running(main, sub):
        main.command("fault swapped")
        sub.command("fault clock-back")
        words = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
        done = ctl(*words, "check", "--hardware", "--long", "--json")
    found = {f["name"]: (f["state"], f["text"]) for f in json.loads(done.out)["findings"]}
    assert found["long pairs"] == ("ok", "6 of 6 over 3 s")
    spellings = "15290000 (on USB 00E94E90) in the config, 00E94E90 (label 15290000) in the library"
    assert found["main serial"][1].startswith(spellings)
    assert found["main serial"][1].endswith("15290000 by the camera itself")
    assert "Point Grey Research" in found["main camera"][1]
    assert "GS3-U3-23S6M" in found["main camera"][1]
    assert found["main clock"][0] == "ok"
    assert "ppm beside ours" in found["main clock"][1]
    assert "counts in steps of 125 us" in found["main clock"][1]
    assert found["sub clock"][0] == "warning"
    assert re.search(r"[1-9] times back", found["sub clock"][1])
    assert found["main numbers"] == ("ok", "from 0 to 5, one by one")
    assert found["main bytes"] == (
        "warning",
        "Mono16 comes with the high byte first; dcam turns it",
    )
    assert found["sub bytes"][0] == "ok"
    assert "low byte first" in found["sub bytes"][1]
    assert "1234.5 -> 1234.500" in found["main exposure"][1]
    left = "left on by another program, now put right: "
    assert left in found["main reports"][1]
    assert "ChunkModeActive True" in found["main reports"][1]
    assert "ChunkModeActive" not in found["sub reports"][1]
    assert "its clock went back, from " in found["sub reports"][1]
    versions = r"dcam \S+, Python 3\.\S+, .+, Linux \S+ \S+, \d+ cores, "
    libraries = r"libaravis-0\.\d+\.so\.0\.\d+\.\d+, libusb"
    assert re.match(versions + libraries, found["versions"][1])


def test_a_long_look_without_cameras_says_what_was_run_and_what_was_met(
    ctl: Ctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first report is most often one of cameras that do not open."""
    monkeypatch.setattr(long_look, "SPAN_S", 0.1)
    monkeypatch.setattr(long_look, "N_PAIRS", 2)
    (tmp_path / "dcam.toml").write_text(laboratory(320, "aravis"))
    words = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    done = ctl(*words, "check", "--hardware", "--long", "--json")
    found = {f["name"]: (f["state"], f["text"]) for f in json.loads(done.out)["findings"]}
    assert "libaravis" in found["versions"][1]
    assert found["long pairs"][1].startswith("0 of 2 over 0 s; camera 1529000")
    assert "not found" in found["long pairs"][1]


def test_long_goes_with_hardware_only(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(laboratory(320, "aravis"))
    done = ctl("--config", tmp_path / "dcam.toml", "check", "--long")
    assert done.code == 2
    assert "only with --hardware" in done.err
