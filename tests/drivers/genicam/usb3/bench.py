"""A USB bus for the tests: `libusb.c` in place of the library, cameras that are processes."""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from tests.drivers.genicam.building import built
from tests.drivers.genicam.gige.process import CameraProcess

SOURCE = Path(__file__).with_name("libusb.c")
HEADER = Path("/usr/include/libusb-1.0/libusb.h")
NAME = "libusb-1.0.so.0"
BUS = "DCAM_TEST_USB_BUS"
SLOW_EVENTS = "DCAM_TEST_USB_SLOW_EVENTS"


class NoBusError(Exception):
    """The stand-in for libusb cannot be built here; the message says what to install."""


@functools.cache
def library() -> Path:
    """Build the stand-in, or find the one built before. Raises NoBusError."""
    if shutil.which("gcc") is None or not HEADER.is_file():
        msg = "no gcc or no libusb.h; apt-get install gcc libc6-dev libusb-1.0-0-dev"
        raise NoBusError(msg)
    return built(SOURCE, NAME, [f"-Wl,-soname,{NAME}", "-lpthread"])


@functools.cache
def load() -> bool:
    """Have Aravis, once it is loaded, find the stand-in: the loader takes a library by its name.

    To be called before Aravis is loaded. False where it cannot be built.
    """
    try:
        ctypes.CDLL(str(library()))
    except NoBusError:
        return False
    return True


def require_bus() -> Path:
    """Give the bus, the same for this process and its children; skips where there can be none."""
    if "gi.repository.Aravis" in sys.modules:
        assert str(library()) in Path("/proc/self/maps").read_text(), "load() came too late"
    if not load():
        with pytest.raises(NoBusError) as error:
            library()
        pytest.skip(f"USB3 cameras: {error.value}")
    return Path(os.environ.get(BUS) or _new_bus())


def _new_bus() -> str:
    """Make the directory that is the bus; it goes with the process that made it."""
    directory = tempfile.mkdtemp(prefix="dcam-usb-")
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    os.environ[BUS] = directory
    return directory


def environment() -> dict[str, str]:
    """What a program needs so that Aravis finds the bus; another Aravis on the path stays there."""
    bus = require_bus()
    folders = [str(library().parent), os.environ.get("LD_LIBRARY_PATH", "")]
    return {**os.environ, BUS: str(bus), "LD_LIBRARY_PATH": ":".join(filter(None, folders))}


class Usb3Process(CameraProcess):
    """A camera at a port of the bus."""

    module: ClassVar[str] = "tests.drivers.genicam.usb3.server"
    place: ClassVar[str] = "--port"

    def __init__(
        self,
        port: str,
        serial: str,
        images: Sequence[Path],
        options: Sequence[str] = (),
        bus: Path | None = None,
    ) -> None:
        """`bus`: another than that of this process."""
        super().__init__(str((bus or require_bus()) / f"{port}.usb"), serial, images, options)


def write_night(directory: Path, height_px: int, width_px: int) -> Path:
    """A dark image, in which the search for a target ends soon."""
    path = directory / "night.png"
    cv2.imwrite(str(path), np.full((height_px, width_px), 9, np.uint8))
    return path
