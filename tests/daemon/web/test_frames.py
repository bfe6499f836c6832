"""The frames of a slot as a browser shows them, with the targets found again."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from daemon.config.reading import load_config
from daemon.devices import open_clock, open_simulated_rig
from daemon.store.database import open_store
from daemon.store.frames.archive import FrameArchive
from drivers.protocols import CapturedFrame
from tests.daemon.commands.conftest import SIMULATED
from tests.daemon.store.examples import START, record, slot
from tests.daemon.web.site import page

TIME = "2026-03-01T00:00:00Z"


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory):
    """A page of one simulated slot; and where the simulation has put its targets, px."""
    directory = tmp_path_factory.mktemp("frames")
    (directory / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    config = load_config(directory / "dcam.toml")
    rig = open_simulated_rig(config, open_clock(config))
    pair = rig.source.capture(START)
    deep = CapturedFrame(pair.sub.pixels.astype(np.uint16) << 4, 12, 1, 1, 0.0)
    pair = replace(pair, sub=deep)  # 12 bits, as many cameras have
    with open_store(directory / "state") as store:
        stored = FrameArchive(directory / "state").store(START, pair)
        row = replace(record(slot(0)), main_frame=stored.main_path, sub_frame=stored.sub_path)
        store.add_measurement(row)
    with page(directory) as browser:
        yield browser, pair, rig.world.disc_centres_px(START)


def decoded(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def test_an_8_bit_frame_is_given_as_it_was_stored(seen) -> None:
    browser, pair, _ = seen
    answer = browser(f"/frames/{TIME}/main")
    assert answer.headers["content-type"] == "image/png"
    assert (decoded(answer.body) == pair.main.pixels).all()


def test_12_bits_are_shown_by_their_upper_8(seen) -> None:
    browser, pair, _ = seen
    found = decoded(browser(f"/frames/{TIME}/sub").body)
    assert found.dtype == np.uint8
    assert (found == pair.sub.pixels >> 4).all()
    assert decoded(browser(f"/frames/{TIME}/sub?width=160").body).shape[1] == 160


def test_the_targets_are_found_again_where_they_are(seen) -> None:
    browser, pair, discs_px = seen
    found = browser(f"/api/slot/{TIME}/targets").json
    assert found["error"] is None
    assert found["size"]["main"] == list(pair.main.pixels.shape[::-1])
    centres_px = np.array([(disc["u"], disc["v"]) for disc in found["main"]])
    assert np.abs(centres_px - discs_px).max() < 0.5
    assert {disc["name"] for disc in found["main"]} == {"main"}
    assert all(3 < disc["r"] < 60 for disc in found["main"])
    assert len(found["sub"]) > 100


def test_aiming_shows_the_last_stored_slot_and_how_to_see_more(seen) -> None:
    browser, _, _ = seen
    look = browser("/api/aim").json
    assert (look["live"], look["time"]) == (False, TIME)
    assert "dcam-ctl preview" in look["trouble"]
    main = look["cameras"]["main"]
    assert main["found"] == "5 of 5 discs found"
    assert decoded(browser(main["frame"]).body).shape[1] == main["width_px"]
    assert browser("/aim/other.jpg").status == 404
