"""`dcam-ctl check`: everything that must be right before the first slot, each with what to do."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Literal

import click
import numpy as np
from scipy.spatial.transform import Rotation

from core.compensation import affine_error_px
from core.site import RigPrior, Site
from daemon.commands.capture import frame_text
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.commands.output import print_json, print_table
from daemon.config import Config, Installation
from daemon.devices import open_clock, open_head, open_pair_source, require_backend
from daemon.errors import ConfigError, DcamError, ExitCode, exit_code_of, lines_of
from daemon.health import dcamd_runs, has_stepped_clock
from daemon.lock import sole_writer
from daemon.store.database import open_store_readonly
from daemon.store.errors import DatabaseMissingError, StoreError
from daemon.synchronised import clock_is_synchronised
from daemon.wording import bytes_text
from drivers.errors import DriverError

SAME_WAY_DEG = 60.0
"""Cameras with less between their directions look the same way."""
LOW_DISK_BYTES = 20e9
"""About a week of full-size pairs, one a minute."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at."""

    name: str
    state: Literal["ok", "warning", "error"]
    text: str
    """What is, and what to do about it."""
    exit_code: ExitCode = ExitCode.DONE


@click.command("check", epilog="\b\nExample:\n  dcam-ctl --config dcam.toml check --hardware")
@click.option(
    "--hardware", is_flag=True, help="Open the cameras too and take a pair; stop dcamd first."
)
@json_option
@common_options
@pass_options
def command(options: Options, hardware: bool, as_json: bool) -> int:
    """Check config, geometry, state, database, calibration and clock; with --hardware cameras.

    Each line is ok, warning or error, and says what to do. Nothing is changed. The exit code is
    that of the first error, 0 when there is none.
    """
    site = options.installation
    findings = [
        Finding("config", "ok", f"{site.config_path}, site {site.config.name}"),
        *_geometry(site.config.site()),
        *_state(site),
        *_database(site),
        _clock(site.config),
        _backend(site.config),
    ]
    if hardware:
        findings += _cameras(site)
        findings += _head(site.config)
    if as_json:
        print_json({"command": "check", "findings": [_fields(finding) for finding in findings]})
    else:
        print_table(("what", "state", "text"), [(f.name, f.state, f.text) for f in findings])
    return next((f.exit_code for f in findings if f.state == "error"), ExitCode.DONE)


def _fields(finding: Finding) -> dict[str, object]:
    return {**asdict(finding), "exit_code": int(finding.exit_code)}


def failed(name: str, error: Exception) -> Finding:
    """A finding that an error makes."""
    return Finding(name, "error", "; ".join(lines_of(error)), exit_code_of(error))


def _geometry(site: Site) -> Iterator[Finding]:
    """What the drawing promises: scale, room for the drift in the main image, Eq. 5."""
    main, target, drift = site.main, site.main_target, site.quality
    px_per_mm = main.focal_px / target.distance_mm
    half_view_mm = np.array([main.width_px, main.height_px]) / 2.0 / px_per_mm
    half_target_mm = np.abs(target.centres_mm).max(axis=0) + target.diameters_mm.max() / 2.0
    free_mm = float((half_view_mm - half_target_mm).min())
    drift_mm = drift.expected_drift_mrad * 1e-3 * target.distance_mm + drift.expected_drift_mm
    text = (
        f"{px_per_mm:.3g} px/mm at {target.distance_mm:g} mm; the target may move {free_mm:.0f} mm "
        f"before it leaves the image, the expected drift alone is {drift_mm:.0f} mm"
    )
    if free_mm < drift_mm:
        yield Finding("main image", "warning", f"{text}: a shorter lens gives more room")
    else:
        yield Finding("main image", "ok", text)
    off_axis_px = float(np.abs(target.centres_mm).max()) * px_per_mm
    eq5_px = affine_error_px(target.distance_mm, drift.expected_drift_mm, off_axis_px)
    state: Literal["ok", "warning"] = "ok" if eq5_px < 1.0 else "warning"
    yield Finding("Eq. 5", state, f"{eq5_px:.3f} px, must be below 1 px for --method paper")
    yield _directions(site.rig)
    square_px = site.sub_target.square_mm * site.sub.focal_px / site.sub_target.distance_mm
    seen = min(site.sub.width_px, site.sub.height_px) / square_px
    text = f"{square_px:.1f} px a square, {seen:.0f} squares across the shorter side"
    yield Finding("sub image", "ok", text)


def _directions(rig: RigPrior) -> Finding:
    """How the cameras look: two targets in one direction would not tell drift from motion."""
    turned = Rotation.from_euler("xyz", rig.rotation_main_sub_deg, degrees=True)
    angle_deg = float(np.degrees(np.arccos(np.clip(turned.as_matrix()[2, 2], -1.0, 1.0))))
    text = f"drawn with {angle_deg:.0f} degrees between the cameras' directions"
    if angle_deg < SAME_WAY_DEG:
        text += ", looking the same way: is rig.rotation_main_sub_deg right? back to back is 180"
        return Finding("rig", "warning", text)
    return Finding("rig", "ok", text)


def _state(site: Installation) -> Iterator[Finding]:
    state = site.state_directory
    there = next(path for path in (state, *state.parents) if path.is_dir())
    if not os.access(there, os.W_OK | os.X_OK):
        text = f"{there} is not writable; chown it to the user that runs dcamd"
        yield Finding("state", "error", text, ExitCode.HARDWARE)
    else:
        text = str(state) if there == state else f"{state}, made when dcamd or calibrate runs"
        yield Finding("state", "ok", text)
    free = shutil.disk_usage(there).free
    text = f"{bytes_text(free)} free"
    if free < LOW_DISK_BYTES:
        yield Finding("disk", "warning", f"{text}, less than a week of frames: free some space")
    else:
        yield Finding("disk", "ok", text)


def _database(site: Installation) -> Iterator[Finding]:
    try:
        with open_store_readonly(site.state_directory) as store:
            last, active = store.last_slot(), store.active_calibration()
    except DatabaseMissingError:
        yield Finding("database", "warning", "none yet; dcamd or calibrate makes it")
        return
    except StoreError as error:
        yield failed("database", error)
        return
    yield Finding("database", "ok", f"last row {last:%Y-%m-%dT%H:%M:%SZ}" if last else "no rows")
    if active is None:
        text = "none active; run dcam-ctl calibrate, until then rows have no value"
        yield Finding("calibration", "warning", text)
    elif active.config_hash != site.config.config_hash():
        text = f"{active.id}; the config has changed since: calibrate again"
        yield Finding("calibration", "warning", text)
    else:
        state: Literal["ok", "warning"] = "ok" if active.report.passed else "warning"
        yield Finding("calibration", state, f"{active.id}: {active.report.lines[0]}")


def _clock(config: Config) -> Finding:
    if has_stepped_clock(config):
        return Finding("clock", "ok", "simulated")
    if clock_is_synchronised():
        return Finding("clock", "ok", "synchronised")
    text = "not synchronised, as far as the kernel knows; install chrony or check timedatectl"
    return Finding("clock", "warning", text)


def _backend(config: Config) -> Finding:
    if config.camera.main.backend is None and config.camera.sub.backend is None:
        text = "none; enough for calibrate --from and reprocess --from, not for dcamd"
        return Finding("cameras", "warning", text)
    try:
        return Finding("cameras", "ok", f"backend {require_backend(config)}")
    except ConfigError as error:
        return failed("cameras", error)


def _cameras(site: Installation) -> Iterator[Finding]:
    """Open both cameras and take a pair, as a slot would."""
    if dcamd_runs(site.state_directory):
        text = "dcamd has the cameras; systemctl stop dcamd first"
        yield Finding("pair", "error", text, ExitCode.HARDWARE)
        return
    try:
        with sole_writer(site.state_directory, "dcam-ctl check"):
            clock = open_clock(site.config)
            with closing(open_pair_source(site.config, clock)) as source:
                pair = source.capture(clock.now_utc().replace(microsecond=0))
    except (DriverError, DcamError, OSError) as error:
        yield failed("pair", error)
        return
    yield Finding("main frame", "ok", frame_text(pair.main))
    yield Finding("sub frame", "ok", frame_text(pair.sub))
    if pair.skew_s is None:
        text = "not measured: the main camera's line triggers the sub-camera"
        yield Finding("skew", "ok", text)
        return
    skew_ms, limit_ms = 1e3 * abs(pair.skew_s), site.config.quality.max_skew_ms
    text = f"{skew_ms:.2f} ms apart, the limit is {limit_ms:g} ms"
    if skew_ms > limit_ms:
        yield Finding("skew", "warning", f"{text}: check cables and the load of the computer")
    else:
        yield Finding("skew", "ok", text)


def _head(config: Config) -> Iterator[Finding]:
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
