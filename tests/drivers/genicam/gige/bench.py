"""What the tests of real cameras share: whether they can run, images, and one shot."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import MissingLibraryError
from drivers.genicam.aravis_device import load_aravis
from drivers.protocols import Camera, CameraSettings, CapturedFrame
from tests.drivers.genicam.gige.loopback import NoLoopbackError, private_loopback
from tests.drivers.genicam.gige.process import CameraProcess
from tests.waiting import PATIENCE_S

WIDTH_PX, HEIGHT_PX = 96, 64
CLOSE_TIMEOUT_S = 20.0
"""Aravis 0.8.26 may lose the wake-up of a USB3 stream's thread and then never ends closing: it sets
`cancel` and signals without the lock under which the thread looks at it. Nothing is wrong where
this passes on a busy machine: the thread that is left behind ends by itself, and opening waits."""
SETTINGS = CameraSettings(
    *(WIDTH_PX, HEIGHT_PX),
    open_timeout_s=PATIENCE_S,
    command_timeout_s=PATIENCE_S,
    close_timeout_s=CLOSE_TIMEOUT_S,
)
"""For cameras that answer: however busy the machine, no deadline passes that matters."""
QUIET_WIDTH_PX, QUIET_HEIGHT_PX = 448, 304
"""With images not smaller than this Aravis has buffers enough on USB; with fewer it looks for one
without a pause, and to wait costs a processor: see `aravis_device.buffers_for`."""
QUIET = dataclasses.replace(SETTINGS, width_px=QUIET_WIDTH_PX, height_px=QUIET_HEIGHT_PX)
FRAME_TIMEOUT_S = 30.0
"""To wait for a frame that comes."""


@contextmanager
def gige_network() -> Iterator[None]:
    """A network for cameras; skips, with what is missing, where there can be none."""
    try:
        load_aravis()
    except MissingLibraryError as error:
        pytest.skip(f"GigE cameras: {error}")
    try:
        with private_loopback():
            yield
    except NoLoopbackError as error:
        pytest.skip(f"GigE cameras: {error}")


def write_images(
    directory: Path,
    n: int,
    *,
    seed: int,
    bits: int = 8,
    shape: tuple[int, int] = (HEIGHT_PX, WIDTH_PX),
) -> list[Path]:
    """Noise images, so that any pixel lost, moved or changed shows."""
    random = np.random.default_rng(seed)
    paths = []
    for i in range(n):
        pixels = random.integers(0, 2**bits, shape, dtype=np.uint16)
        paths.append(directory / f"{seed}_{i}.png")
        cv2.imwrite(str(paths[-1]), pixels.astype(np.uint8) if bits == 8 else pixels)
    return paths


def read_pixels(path: Path) -> NDArray[Any]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def grab(camera: Camera, timeout_s: float = FRAME_TIMEOUT_S) -> CapturedFrame:
    camera.arm()
    camera.trigger()
    return camera.fetch(timeout_s)


def image_index(pixels: NDArray[Any], images: Sequence[Path]) -> int | None:
    """Which of the images this is, pixel for pixel."""
    for index, path in enumerate(images):
        if np.array_equal(pixels, read_pixels(path)):
            return index
    return None


@contextmanager
def running(*cameras: CameraProcess) -> Iterator[None]:
    """Start the cameras and leave none behind."""
    try:
        for camera in cameras:
            camera.start()
        yield
    finally:
        for camera in cameras:
            camera.kill()
