"""Cameras and head, opened as a slot and a calibration would."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

from daemon.checks.computer import check_camera_heat
from daemon.checks.finding import Finding, failed
from daemon.checks.network import check_network
from daemon.checks.usb import check_usb
from daemon.config.reading import Config, Installation
from daemon.control.control_socket import ask_daemon
from daemon.devices import (
    found_on_network,
    open_clock,
    open_head,
    open_pair_source,
    require_backend,
)
from daemon.errors import ConfigError, DcamError
from daemon.lock import sole_writer
from daemon.slots.snapshot import frame_text, pair_fields, recognition_problems
from drivers.errors import DriverError


def check_backend(config: Config) -> Finding:
    """Whether the config names cameras that there is a driver for."""
    if config.camera.main.backend is None and config.camera.sub.backend is None:
        text = "none; enough for calibrate --from and reprocess --from, not for dcamd"
        return Finding("cameras", "warning", text)
    try:
        return Finding("cameras", "ok", f"backend {require_backend(config)}")
    except ConfigError as error:
        return failed("cameras", error)


def check_links(config: Config) -> Iterator[Finding]:
    """Look at the way from here to each camera, without opening any."""
    if config.camera.main.backend not in {"aravis", "harvesters"}:
        return
    yield from check_usb(config)
    try:
        addresses = found_on_network(config)
    except (DriverError, DcamError) as error:
        yield failed("links", error)
        return
    yield from check_network(config, addresses)


def check_cameras(site: Installation) -> Iterator[Finding]:
    """Take a pair as a slot would; where dcamd runs, it takes it itself between two slots."""
    try:
        pair = _pair(site)
    except (DriverError, DcamError, OSError) as error:
        yield failed("pair", error)
        return
    for role in ("main", "sub"):
        yield Finding(f"{role} frame", "ok", frame_text(pair[role]))
    yield from _targets(pair.get("problems", []))
    yield from check_camera_heat(pair)
    skew_s = pair["skew_s"]
    if skew_s is None:
        text = "not measured: the main camera's line triggers the sub-camera"
        yield Finding("skew", "ok", text)
        return
    skew_ms, limit_ms = 1e3 * abs(skew_s), site.config.quality.max_skew_ms
    text = f"{skew_ms:.2f} ms apart, the limit is {limit_ms:g} ms"
    if skew_ms > limit_ms:
        yield Finding("skew", "warning", f"{text}: check cables and the load of the computer")
    else:
        yield Finding("skew", "ok", text)


def _pair(site: Installation) -> dict[str, Any]:
    answer = ask_daemon(site.state_directory, "capture")
    if answer is not None and answer.look is not None:
        return answer.look
    with sole_writer(site.state_directory, "dcam-ctl check"):
        clock = open_clock(site.config)
        with closing(open_pair_source(site.config, clock)) as source:
            pair = source.capture(clock.now_utc().replace(microsecond=0))
    return {**pair_fields(pair), "problems": recognition_problems(pair, site.config.site())}


def _targets(problems: Sequence[str]) -> Iterator[Finding]:
    """Whether both targets are recognised; a rig that is not aimed yet is no error."""
    for role in ("main", "sub"):
        mine = [problem for problem in problems if problem.startswith(role)]
        if mine:
            yield Finding(f"{role} target", "warning", "; ".join(mine))
        else:
            yield Finding(f"{role} target", "ok", "recognised")


def check_head(config: Config) -> Iterator[Finding]:
    """Ask the head at the port, if there is one, who and where it is; nothing moves."""
    if not config.pan_tilt.is_serial:
        return
    try:
        with closing(open_head(config)) as head:
            report = head.describe()
    except (DriverError, DcamError) as error:
        yield failed("head", error)
        return
    yield Finding("head", "ok", f"{report.name} at {config.pan_tilt.port}")
    if report.position_deg is None:
        text = "answers nothing: it is moved by time, and only the images show where it is"
        yield Finding("head position", "warning", text)
    else:
        pan_deg, tilt_deg = report.position_deg
        home = config.pan_tilt.home_deg
        text = f"pan {pan_deg:.3f} tilt {tilt_deg:.3f} deg, home is {home[0]:g} {home[1]:g}"
        yield Finding("head position", "ok", text)
    if report.limits_deg is not None:
        pan, tilt = report.limits_deg
        text = f"pan {pan[0]:.1f} to {pan[1]:.1f}, tilt {tilt[0]:.1f} to {tilt[1]:.1f} deg"
        yield Finding("head limits", "ok", text)
    if report.power is not None:
        yield Finding("head power", "ok", report.power)
