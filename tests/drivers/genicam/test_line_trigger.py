"""One GenICam camera's line triggers the other: one trigger a pair, by whichever library."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.clock import SystemClock
from drivers.errors import FrameTimeoutError
from drivers.pair import SynchronizedPair
from drivers.protocols import LineOut, TriggerIn
from tests.drivers.genicam.gige.bench import (
    QUIET,
    QUIET_HEIGHT_PX,
    QUIET_WIDTH_PX,
    image_index,
    running,
    write_images,
)
from tests.drivers.genicam.gige.kinds import Kind
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.drivers.genicam.gige.process import CameraProcess
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.usefixtures("forked_workers")

MAIN, SUB = "15290000", "15290001"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("images")
    return write_images(folder, 3, seed=2, shape=(QUIET_HEIGHT_PX, QUIET_WIDTH_PX))


@pytest.fixture
def wired(kind: Kind, images: list[Path]) -> Iterator[tuple[CameraProcess, CameraProcess]]:
    main, sub = (
        kind.process(address, serial, images)
        for address, serial in zip(ADDRESSES, (MAIN, SUB), strict=True)
    )
    main.wire(2, sub, 3)
    with running(main, sub):
        yield main, sub


@pytest.fixture
def pair(kind: Kind, wired: tuple[CameraProcess, CameraProcess]) -> Iterator[SynchronizedPair]:
    cameras = (
        kind.make(MAIN, replace(QUIET, line_out=LineOut("Line2")), "main"),
        kind.make(SUB, replace(QUIET, trigger=TriggerIn("Line3")), "sub"),
    )
    opened = SynchronizedPair(
        *cameras,
        SystemClock(),
        open_timeout_s=PATIENCE_S,
        grace_s=PATIENCE_S,
        main_triggers_sub=True,
    )
    with closing(opened):
        yield opened


def test_the_main_camera_triggers_the_sub_camera_through_a_wire(
    pair: SynchronizedPair,
    wired: tuple[CameraProcess, CameraProcess],
    images: list[Path],
) -> None:
    """One frame each a slot, the same scene; and no skew is claimed that nobody measured."""
    for n in range(3):
        taken = pair.capture(SystemClock().now_utc())
        shown = [image_index(frame.pixels, images) for frame in (taken.main, taken.sub)]
        assert shown == [n, n]
        assert taken.skew_s is None
    assert [len(camera.frames) for camera in wired] == [3, 3]


def test_a_broken_wire_is_named_and_no_frame_is_taken_for_another(
    pair: SynchronizedPair,
    wired: tuple[CameraProcess, CameraProcess],
    images: list[Path],
) -> None:
    main, sub = wired
    pair.capture(SystemClock().now_utc())
    main.wire(2, sub, 0)  # a line nobody listens to
    with pytest.raises(FrameTimeoutError, match=f"camera {SUB}: .*check the wire .* Line3") as lost:
        pair.capture(SystemClock().now_utc())
    assert lost.value.role == "sub"
    main.wire(2, sub, 3)
    taken = pair.capture(SystemClock().now_utc())
    assert image_index(taken.main.pixels, images) == 2
    assert image_index(taken.sub.pixels, images) == 1  # its second frame: the edge it missed
