"""The disk under the state directory: room for what is to be kept, and fast enough for a slot."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

from daemon.checks.finding import Finding, failed, unless
from daemon.checks.usb import frame_bytes
from daemon.config import Config
from daemon.store.durable import write_durable
from daemon.wording import bytes_text

DAY_S = 86_400
WEEK_DAYS = 7.0
SLOW_SHARE = 0.1
"""Of a period: a disk that takes longer for a slot's frames leaves no room for a bad moment."""
TRIES = 3
"""Of which the slowest counts: a slot waits for that one."""


def slot_bytes(config: Config) -> int:
    """Give the size of a slot's images; on the disk they are compressed, and smaller."""
    pair = frame_bytes(config, "main") + frame_bytes(config, "sub")
    return pair * config.schedule.burst


def check_room(config: Config, state: Path) -> Finding:
    """Free space, in days of frames."""
    there = next(path for path in (state, *state.parents) if path.is_dir())
    free = shutil.disk_usage(there).free
    days = free / (slot_bytes(config) * DAY_S / config.schedule.period_s)
    text = f"{bytes_text(free)} free, at least {days:.3g} days of frames"
    cure = "free some space, or put [storage] directory on a larger disk"
    return unless(days >= WEEK_DAYS, "disk", text, cure)


def check_speed(config: Config, state: Path) -> Iterator[Finding]:
    """Store frames of a slot's size as a slot would, and take them away again."""
    if not state.is_dir():
        return
    try:
        took_s = config.schedule.burst * max(_store_pair(config, state) for _ in range(TRIES))
    except OSError as error:
        yield failed("disk speed", error)
        return
    period_s = config.schedule.period_s
    text = f"{took_s:.2g} s to store a slot's frames for good, of {period_s} s"
    cure = "an SSD, or a longer period_s; smartctl -a tells whether the disk is failing"
    yield unless(took_s < SLOW_SHARE * period_s, "disk speed", text, cure)


def _store_pair(config: Config, state: Path) -> float:
    """Give the seconds it took."""
    with tempfile.TemporaryDirectory(prefix=".check-", dir=state) as directory:
        images = [os.urandom(frame_bytes(config, role)) for role in ("main", "sub")]
        before_s = monotonic()
        for number, image in enumerate(images):
            write_durable(Path(directory) / str(number), image)
        return monotonic() - before_s
