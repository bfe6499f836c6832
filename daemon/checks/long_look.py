"""A look at both cameras over some minutes: what only the real camera knows.

Its lines are what a first report from real hardware should hold: both spellings of the serial
number, model and firmware, the camera's clock beside ours, its frame numbers, exposure steps and
when they count, order of bytes, what could not be set, and what another program had left.
"""

from __future__ import annotations

import logging
import os
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from daemon.checks.finding import Finding, failed
from daemon.checks.long_frames import (
    Shown,
    camera_clock,
    exposure_delay,
    exposure_steps,
    frame_numbers,
    shown,
)
from daemon.config.reading import Config, Installation
from daemon.config.site import CameraSection
from daemon.devices import open_clock, open_pair_source
from daemon.errors import DcamError
from daemon.lock import sole_writer
from daemon.version import VERSION
from drivers.errors import DeviceError, DriverError
from drivers.genicam.byte_order import is_swapped
from drivers.genicam.serial_number import as_on_label, as_on_usb
from drivers.protocols import CapturedFrame, Clock, FramePairSource, Role

N_PAIRS = 20
SPAN_S = 133.0
"""Longer than 128 s, after which the clock of some FLIR cameras may begin again (IEEE 1394's)."""
EXPOSURES_US = (1000.0, 1234.5, 2500.0, 5000.0)
"""Asked for in turns, to see the camera's steps."""
DEEP = "Mono16"
"""The format in which some cameras send their bytes in the wrong order."""
ROLES: tuple[Role, Role] = ("main", "sub")
SAYINGS = {
    "camera_setting_not_applied": "not set: {reason}",
    "camera_setting_differs": "{feature} is {actual}, {wanted} was asked for",
    "camera_left_by_another": "left on by another program, now put right: {found}",
    "camera_byte_order": "sends the high byte of deep pixels first: {high_byte_first}",
    "camera_clock_went_back": "its clock went back, from {before_s:.3f} to {now_s:.3f} s",
    "camera_listed_more_than_once": "listed more than once: {opened} was opened, not {others}",
    "stale_frame_refused": "an old frame came once more: {frame_id}",
    "stale_frames_dropped": "{frames} frames came that nobody had asked for",
    "camera_lost": "was lost: {error}",
}
"""Events of the drivers that belong into the report, and how it puts them."""


@dataclass(slots=True)
class _Look:
    frames: dict[Role, list[Shown]] = field(default_factory=lambda: {role: [] for role in ROLES})
    failures: list[str] = field(default_factory=list)
    events: list[Mapping[str, Any]] = field(default_factory=list)
    deep: str = ""
    """Why there is no deep pair; empty where there is one."""
    deep_in_order: dict[Role, bool] = field(default_factory=dict)
    """Whether its image shows that the order of its bytes is right now."""


def check_long(site: Installation) -> Iterator[Finding]:
    """Take pairs over SPAN_S, with cameras that nobody else has open."""
    yield Finding("versions", "ok", _versions(site.config))
    look = _Look()
    try:
        with sole_writer(site.state_directory, "dcam-ctl check --long"), _events(look.events):
            clock = open_clock(site.config)
            with closing(open_pair_source(site.config, clock)) as source:
                _take(source, clock, look)
            _take_deep(site.config, clock, look)
    except (DriverError, DcamError, OSError) as error:
        yield failed("long", error)
        return
    yield Finding(
        "long pairs",
        "warning" if look.failures else "ok",
        f"{len(look.frames['main'])} of {N_PAIRS} over {SPAN_S:.0f} s"
        + "".join(f"; {failure}" for failure in dict.fromkeys(look.failures)),
    )
    for role in ROLES:
        yield from _of_camera(role, site.config, look)


def _take(source: FramePairSource, clock: Clock, look: _Look) -> None:
    for k in range(N_PAIRS):
        exposure_us = EXPOSURES_US[k % len(EXPOSURES_US)]
        for role in ROLES:
            source.set_exposure(role, exposure_us, None)
        try:
            pair = source.capture(clock.now_utc().replace(microsecond=0))
        except DeviceError as error:
            look.failures.append(str(error))
        else:
            look.frames["main"].append(shown(pair.main, exposure_us))
            look.frames["sub"].append(shown(pair.sub, exposure_us))
        if k + 1 < N_PAIRS:
            clock.pause(SPAN_S / (N_PAIRS - 1))


def _take_deep(config: Config, clock: Clock, look: _Look) -> None:
    """Take one pair of 16 bits, whose order of bytes the drivers look at; 8 bits have none."""
    if config.camera.main.backend not in {"aravis", "harvesters"}:
        look.deep = "not a real camera"
        return
    deep: dict[str, CameraSection] = {
        role: config.camera.of(role).model_copy(update={"pixel_format": DEEP}) for role in ROLES
    }
    changed = config.model_copy(update={"camera": config.camera.model_copy(update=deep)})
    for tries_left in (1, 0):  # a camera that was just closed may not answer at once
        try:
            with closing(open_pair_source(changed, clock)) as source:
                pair = source.capture(clock.now_utc().replace(microsecond=0))
            break
        except DriverError as error:
            if not tries_left:
                look.deep = str(error)
                return
    taken: tuple[tuple[Role, CapturedFrame], ...] = (("main", pair.main), ("sub", pair.sub))
    for role, frame in taken:
        look.deep_in_order[role] = is_swapped(frame.pixels, frame.bits) is False


@contextmanager
def _events(into: list[Mapping[str, Any]]) -> Iterator[None]:
    """Collect what the drivers log meanwhile, also what the log itself is not to have."""
    logger, above = logging.getLogger("dcam.drivers"), logging.getLogger("dcam")
    wanted = logger.getEffectiveLevel()

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if isinstance(record.msg, dict):
                into.append(record.msg)
            if record.levelno >= wanted:
                above.handle(record)

    collector, before = Collector(), (logger.level, logger.propagate)
    logger.addHandler(collector)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(collector)
        logger.setLevel(before[0])
        logger.propagate = before[1]


def _of_camera(role: Role, config: Config, look: _Look) -> Iterator[Finding]:
    serial = str(config.camera.of(role).serial)
    mine = [event for event in look.events if _is_of(event, serial, role)]
    identity = next((event for event in mine if event["event"] == "camera_identity"), {})
    yield Finding(f"{role} serial", "ok", _serials(serial, identity))
    yield Finding(f"{role} camera", "ok", _plain(identity.get("said")) or "tells nothing of itself")
    frames = look.frames[role]
    if len(frames) > 1:
        yield camera_clock(f"{role} clock", frames)
        yield frame_numbers(f"{role} numbers", frames)
        yield exposure_steps(f"{role} exposure", frames)
        yield exposure_delay(f"{role} new exposure", frames)
    yield _byte_order(role, mine, look)
    said = _said(mine)
    yield Finding(f"{role} reports", "warning" if said else "ok", "; ".join(said) or "nothing odd")


def _serials(configured: str, identity: Mapping[str, Any]) -> str:
    """The number of the config, of the library's list and of the camera itself."""
    own = identity.get("said", {}).get("DeviceSerialNumber")
    parts = [f"{as_on_usb(configured)} in the config"]
    parts += (
        [f"{as_on_label(identity['listed'])} in the library's list"] if "listed" in identity else []
    )
    parts += [f"{own} by the camera itself"] if own else []
    return ", ".join(parts)


def _byte_order(role: Role, mine: list[Mapping[str, Any]], look: _Look) -> Finding:
    name = f"{role} bytes"
    orders = [event["high_byte_first"] for event in mine if event["event"] == "camera_byte_order"]
    if any(orders):
        return Finding(name, "warning", f"{DEEP} comes with the high byte first; dcam turns it")
    if look.deep:
        return Finding(name, "ok", f"order not seen: {look.deep}")
    if not look.deep_in_order[role]:
        text = f"order not seen: the {DEEP} image shows too little; take it before lit targets"
        return Finding(name, "warning", text)
    return Finding(name, "ok", f"{DEEP} comes with the low byte first, as it should")


def _versions(config: Config) -> str:
    """What was run: dcam, Python, the computer, and the libraries on the way to the cameras."""
    mapped = re.findall(r"/(lib(?:aravis|usb-1)\S*)", Path("/proc/self/maps").read_text("utf-8"))
    try:
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        system = platform.system()
    parts = [
        *(f"dcam {VERSION}", f"Python {platform.python_version()}", system),
        *(f"Linux {platform.release()} {platform.machine()}", f"{os.cpu_count()} cores"),
        *sorted(set(mapped)),
    ]
    if config.camera.main.backend == "harvesters":
        parts += [f"{name} {metadata.version(name)}" for name in ("harvesters", "genicam")]
        parts.append(f"producer {config.genicam.producer or 'of the environment'}")
    return ", ".join(parts)


def _plain(value: object) -> str:
    """A camera's features with their values, as people write them."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {one}" for name, one in value.items())
    return "" if value is None else str(value)


def _is_of(event: Mapping[str, Any], serial: str, role: Role) -> bool:
    mine = event.get("serial") == serial or event.get("role") == role
    return mine or serial in str(event.get("reason", ""))


def _said(events: list[Mapping[str, Any]]) -> list[str]:
    """What the driver logged of a camera, each once."""
    lines = []
    for event in events:
        words = SAYINGS.get(str(event.get("event")))
        if words is not None:
            given = {
                name: _plain(value) if isinstance(value, Mapping) else value
                for name, value in event.items()
            }
            lines.append(words.format_map(given))
    return list(dict.fromkeys(lines))
