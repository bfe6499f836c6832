"""`dcam-ctl capture`: the pair or burst of one slot now, measured and printed."""

from __future__ import annotations

from contextlib import closing
from datetime import datetime
from pathlib import Path

import click

from core.exposure import Exposure
from core.results import Measurement
from daemon.burst import take_burst
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.commands.output import print_json, result_fields, say
from daemon.devices import open_clock, open_pair_source
from daemon.errors import ExitCode
from daemon.exposure import last_known, loop_of, settle
from daemon.lock import sole_writer
from daemon.measuring import ActiveCalibration, active_calibration, image_pair, measure
from daemon.sequence import in_sequence
from daemon.store.database import open_store_readonly
from daemon.store.errors import DatabaseMissingError
from daemon.wording import utc_text, value_text
from drivers.protocols import CapturedFrame, CapturedPair, Role


@click.command("capture", epilog="\b\nExample:\n  dcam-ctl capture --json")
@json_option
@common_options
@pass_options
def command(options: Options, as_json: bool) -> int:
    """Take one slot's pairs now, measure them with the active calibration, and print the result.

    `[schedule] burst` says how many they are; with `[exposure] mode = "auto"` light is settled
    first, a second a look. Nothing is recorded. The cameras must be free:
    stop dcamd first. Exit code 1 if the slot gave no value, 4 if no pair could be taken.
    """
    config, state = options.config, options.state
    with sole_writer(state, "dcam-ctl capture"):
        calibration, last_utc, exposures = _known(state)
        loop = loop_of(config)
        clock = open_clock(config, last_utc)
        with closing(open_pair_source(config, clock)) as source:
            if loop is not None:
                loop.begin(source, exposures)
                settle(source, clock, loop)
            slot_utc = clock.now_utc().replace(microsecond=0)
            shots = take_burst(source, clock, slot_utc, config.burst_plan())
    site = config.site()
    measurement = measure((image_pair(shot.pair) for shot in shots), site, calibration)
    if calibration is not None:
        with open_store_readonly(state) as store:
            measurement = in_sequence(store, calibration, site.quality, slot_utc, measurement)
    pair = shots[0].pair
    if as_json:
        row = result_fields(slot_utc, measurement)
        fields = {"measurement": row, "pairs": len(shots), **_pair_fields(pair)}
        print_json({"command": "capture", **fields})
    else:
        say(f"{utc_text(slot_utc)}  {value_text(measurement)}")
        say_details(measurement, pair)
    return ExitCode.FAILED if measurement.corrected is None else ExitCode.DONE


def _known(
    state: Path,
) -> tuple[ActiveCalibration | None, datetime | None, dict[Role, Exposure]]:
    """The active calibration, where the record ends, and its last exposures.

    A state may still be empty.
    """
    try:
        with open_store_readonly(state) as store:
            accounted = store.accounted()
            last_utc = accounted[1] if accounted else None
            return active_calibration(store), last_utc, last_known(store)
    except DatabaseMissingError:
        return None, None, {}


def say_details(measurement: Measurement, pair: CapturedPair) -> None:
    """Print what lies behind a value: the main camera alone, the rig's motion, the two frames."""
    if measurement.spread_mm is not None:
        x_mm, y_mm = measurement.spread_mm
        say(f"spread       x {x_mm:.3f} mm, y {y_mm:.3f} mm, of {measurement.frames_used} pairs")
    if measurement.raw is not None:
        x_mm, y_mm = measurement.raw.mm
        say(f"raw          x {x_mm:+.3f} mm, y {y_mm:+.3f} mm")
    if measurement.motion is not None:
        rx, ry, rz = 1e3 * measurement.motion.rotation_rad
        tx, ty, tz = measurement.motion.translation_mm
        say(f"rig rotation x {rx:+.4f}, y {ry:+.4f}, z {rz:+.4f} mrad")
        say(f"rig shift    x {tx:+.4f}, y {ty:+.4f}, z {tz:+.4f} mm")
    seen = measurement.diagnostics
    say(f"seen         {seen.discs_found} discs, {seen.corners_used} corners")
    skew = "not measured" if pair.skew_s is None else f"{1e3 * pair.skew_s:+.2f} ms"
    say(f"skew         {skew}")
    for name, frame in (("main", pair.main), ("sub", pair.sub)):
        say(f"{name:<12} {frame_text(frame)}")


def frame_text(frame: CapturedFrame) -> str:
    """A frame's size, light and settings in one line."""
    height, width = frame.pixels.shape
    light = float(frame.pixels.max()) / (2**frame.bits - 1)
    parts = [f"{width}x{height} px, {frame.bits} bits, brightest pixel at {light:.0%}"]
    for value, unit in (
        (frame.exposure_us, "us"),
        (frame.gain_db, "dB"),
        (frame.temperature_c, "°C"),
    ):
        if value is not None:
            parts.append(f"{value:g} {unit}")
    return ", ".join(parts)


def _pair_fields(pair: CapturedPair) -> dict[str, object]:
    def fields(frame: CapturedFrame) -> dict[str, object]:
        return {
            "width_px": frame.pixels.shape[1],
            "height_px": frame.pixels.shape[0],
            "bits": frame.bits,
            "mean_dn": float(frame.pixels.mean()),
            "max_dn": int(frame.pixels.max()),
            "exposure_us": frame.exposure_us,
            "gain_db": frame.gain_db,
            "temperature_c": frame.temperature_c,
        }

    return {"skew_s": pair.skew_s, "main": fields(pair.main), "sub": fields(pair.sub)}
