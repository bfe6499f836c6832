"""What each of our programs would load and compile, done once: see tests/programs.py."""

from __future__ import annotations

import gc
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import daemon

import cv2  # isort: skip
import daemon.commands.capture
import daemon.commands.check
import daemon.commands.status_here  # noqa: F401
import drivers.genicam.session  # noqa: F401
from core.measurement import look_at_pair
from daemon.control.control_socket import control_socket  # noqa: F401
from daemon.slots.identity import made_by
from daemon.slots.service import Service  # noqa: F401
from daemon.store.opening import open_checked_store
from drivers.errors import MissingLibraryError
from drivers.genicam.gentl_device import load_harvesters
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.core.scenes import grey, small_site


def look_once() -> None:
    """Draw a pair and look at it, with one thread: a fork does not have the others."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    world = World(small_site(), SimSettings())
    look_at_pair(
        grey(world, "main", world.settings.start_utc),
        grey(world, "sub", world.settings.start_utc),
        world.site,
    )
    cv2.setNumThreads(threads)


look_once()
made_by()
with suppress(MissingLibraryError):
    load_harvesters()
with TemporaryDirectory() as directory:
    open_checked_store(Path(directory)).close()
gc.collect()
gc.freeze()  # no fork looks for garbage in it, which would copy its pages
