"""The disk under the state directory: room for what is to be kept, and fast enough for a slot."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

from core.errors import digits
from daemon.checks.finding import Finding, failed, unless
from daemon.checks.usb import frame_bytes
from daemon.config.reading import Config
from daemon.durable import write_durable
from daemon.errors import StoreError
from daemon.store.database import open_store_readonly
from daemon.store.records import Thinning
from daemon.text import bytes_text

DAY_S = 86_400
YEAR_DAYS = 365.0
SLOW_SHARE = 0.1
"""Of a period: a disk that takes longer for a slot's frames leaves no room for a bad moment."""
TRIES = 3
"""Of which the slowest counts: a slot waits for that one."""


def slot_bytes(config: Config) -> int:
    """Give the size of a slot's images; on the disk they are compressed, and smaller."""
    pair = frame_bytes(config, "main") + frame_bytes(config, "sub")
    return pair * config.schedule.burst


def check_room(config: Config, state: Path) -> Finding:
    """Free space against what the configured retention will keep."""
    there = next(path for path in (state, *state.parents) if path.is_dir())
    rules = config.retention.rules()
    room = max(shutil.disk_usage(there).free + _kept_bytes(state) - rules.min_free_bytes, 0.0)
    wanted = min(retention_bytes(config), rules.max_bytes)
    days = room / (slot_bytes(config) * DAY_S / config.schedule.period_s)
    text = f"room for {bytes_text(room)} of frames, [retention] keeps at most {bytes_text(wanted)}"
    cure = (
        f"frames go sooner than it says, every slot's after {digits(days, 2)} days if nothing else "
        "is kept; free some space, put [storage] directory on a larger disk, or ask for less"
    )
    return unless(room >= wanted, "disk", text, cure)


def retention_bytes(config: Config) -> float:
    """Give what the rules keep in their first year (or up to frames_days, if that is less)."""
    rules = config.retention.rules()
    per_day = {
        Thinning.EVERY_SLOT: DAY_S / config.schedule.period_s,
        Thinning.HOURLY: min(24.0, DAY_S / config.schedule.period_s),
        Thinning.DAILY: 1.0,
    }
    slots, since = 0.0, 0.0
    for level, slots_a_day in per_day.items():
        until = min(rules.limit_days(level), YEAR_DAYS)
        slots += max(until - since, 0.0) * slots_a_day
        since = max(until, since)
    return slots * slot_bytes(config)


def _kept_bytes(state: Path) -> int:
    """What the frames take already, as last counted; without a database there are none."""
    try:
        with open_store_readonly(state) as store:
            return sum(day.bytes for day in store.frame_days())
    except StoreError:
        return 0


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
