"""`dcam-ctl check --hardware --long` on two USB3 cameras that do what real ones may."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.checks import long_look
from tests.daemon.commands.conftest import Ctl
from tests.drivers.genicam.gige.bench import gige_network, running
from tests.drivers.genicam.usb3.bench import Usb3Process, require_bus, write_night
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
    image = write_night(tmp_path, 200, 320)
    main = Usb3Process("1", "15290000", [image], ["--left", "b100=1"])
    sub = Usb3Process("2", "15290001", [image])
    with running(main, sub):
        sub.command("fault clock-back")
        words = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
        done = ctl(*words, "check", "--hardware", "--long", "--json")
    found = {f["name"]: (f["state"], f["text"]) for f in json.loads(done.out)["findings"]}
    assert found["long pairs"] == ("ok", "6 of 6 over 3 s")
    assert found["main serial"] == ("ok", "15290000 (on USB 00E94E90)")
    assert found["main clock"][0] == "ok"
    assert "ppm beside ours" in found["main clock"][1]
    assert found["sub clock"][0] == "warning"
    assert "went back" in found["sub clock"][1]
    assert "1234.5 -> 1234.500" in found["main exposure"][1]
    left = "left on by another program, now put right: "
    assert left in found["main reports"][1]
    assert "ChunkModeActive True" in found["main reports"][1]
    assert "ChunkModeActive" not in found["sub reports"][1]
    assert "its clock went back, from " in found["sub reports"][1]
    versions = r"dcam \S+, Python 3\.\S+, Linux \S+, libaravis-0\.\d+\.so\.0\.\d+\.\d+, libusb"
    assert re.match(versions, found["versions"][1])


def test_long_goes_with_hardware_only(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(laboratory(320, "aravis"))
    done = ctl("--config", tmp_path / "dcam.toml", "check", "--long")
    assert done.code == 2
    assert "only with --hardware" in done.err
