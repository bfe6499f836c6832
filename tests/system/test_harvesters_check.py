"""`dcam-ctl check --hardware` with cameras on the network, the sub-camera triggered by a wire."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drivers.genicam.gentl.bench import producer
from tests.drivers.genicam.gige.bench import gige_network, running, write_images
from tests.drivers.genicam.gige.kinds import kind_of
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.laboratory import laboratory
from tests.programs import ran

CONFIG = (
    laboratory(720, "harvesters")
    + """
[trigger]
mode = "hardware"
[genicam]
producer = "PRODUCER"
"""
)


def check(
    directory: Path, cti: Path, backend: str = "harvesters"
) -> tuple[int, dict[str, tuple[str, str]], str]:
    """Exit code, findings by name as (state, text), and stderr."""
    config = directory / "dcam.toml"
    config.write_text(CONFIG.replace("PRODUCER", str(cti)).replace("harvesters", backend))
    where = ("--config", config, "--state", directory / "state")
    done = ran("daemon.ctl", *where, "check", "--hardware", "--json")
    findings = json.loads(done.stdout)["findings"]
    return done.returncode, {f["name"]: (f["state"], f["text"]) for f in findings}, done.stderr


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with gige_network():
        kind = kind_of("harvesters")
        images = write_images(tmp_path_factory.mktemp("i"), 1, seed=11, shape=(450, 720))
        main, sub = (
            kind.process(address, serial, images)
            for address, serial in zip(ADDRESSES, ("15290000", "15290001"), strict=True)
        )
        main.wire(2, sub, 3)
        with running(main, sub):
            yield


def test_both_cameras_are_found_and_take_a_pair(cameras: None, tmp_path: Path) -> None:
    code, findings, stderr = check(tmp_path, producer())
    assert code == 0, findings
    assert findings["cameras"] == ("ok", "backend harvesters")
    assert findings["main frame"][0] == findings["sub frame"][0] == "ok"
    assert findings["skew"][1].startswith("not measured")
    assert "Traceback" not in stderr


def test_the_way_to_a_gige_camera_is_looked_at(cameras: None, tmp_path: Path) -> None:
    code, findings, _ = check(tmp_path, producer(), "aravis")
    assert code == 0, findings
    for role, address in zip(("main", "sub"), ADDRESSES, strict=True):
        assert findings[f"{role} link"] == ("ok", f"{address} through lo")
        assert findings[f"{role} packets"][0] == "ok"
    assert "an image has 0.324 MB" in findings["receive buffer"][1]


def test_a_producer_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    code, findings, stderr = check(tmp_path, Path("/nowhere/vendor.cti"))
    assert code == 4
    assert findings["pair"] == (
        "error",
        "/nowhere/vendor.cti: no such GenTL producer; set genicam.producer to the vendor's .cti",
    )
    assert "Traceback" not in stderr
