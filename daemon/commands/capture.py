"""`dcam-ctl capture`: the pair or burst of one slot now, measured and printed."""

from __future__ import annotations

from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import click

from core.exposure.exposure_rule import Exposure
from core.results import Flag, Reason
from daemon.burst import take_burst
from daemon.commands.options import Options, common_options, json_option, pass_options, tz_option
from daemon.commands.output import print_json, say
from daemon.control.control_socket import ask_daemon
from daemon.devices import open_clock, open_pair_source
from daemon.errors import DatabaseMissingError, ExitCode
from daemon.lock import sole_writer
from daemon.readings.sampler import open_sampler
from daemon.slots.exposure import last_known, loop_of, settle
from daemon.slots.learner import Learner
from daemon.slots.measuring import ActiveCalibration, active_calibration
from daemon.slots.snapshot import frame_text, look_fields, measure_look
from daemon.store.database import open_store_readonly
from drivers.protocols import Role

_TO_CALIBRATE = (
    "there is no calibration in use yet; take lens views with dcam-ctl calibrate --intrinsics, "
    "then run dcam-ctl calibrate --pan-tilt"
)


@click.command("capture", epilog="\b\nExample:\n  dcam-ctl capture --json")
@json_option
@tz_option
@common_options
@pass_options
def command(options: Options, as_json: bool) -> int:
    """Take one slot's pairs now, measure them with the active calibration, and print the result.

    `[schedule] burst` says how many they are. Nothing is recorded. Where dcamd runs, it takes them
    itself between two slots, and no slot is delayed. Else, with `[exposure] mode = "auto"`, the
    light is settled first, a second a look. Exit code 1 if the slot gave no value, 4 if no pair
    could be taken.
    """
    answer = ask_daemon(options.state, "capture")
    look = _look(options) if answer is None or answer.look is None else answer.look
    if as_json:
        print_json({"command": "capture", **look})
    else:
        say_look(look)
    return ExitCode.FAILED if look["measurement"]["x_mm"] is None else ExitCode.DONE


def _look(options: Options) -> dict[str, Any]:
    """Take and measure pairs where no dcamd runs."""
    config, state = options.config, options.state
    with sole_writer(state, "dcam-ctl capture"):
        calibration, last_utc, exposures = _known(state)
        loop = loop_of(config)
        clock = open_clock(config, last_utc)
        with (
            closing(open_pair_source(config, clock)) as source,
            closing(open_sampler(config)) as sampler,
        ):
            if loop is not None:
                loop.begin(source, exposures)
                settle(source, clock, loop)
            slot_utc = clock.now_utc().replace(microsecond=0)
            shots = take_burst(source, clock, slot_utc, config.burst_plan())
            readings = sampler.between_slots(slot_utc)
    site, learner = config.site(), Learner()
    if calibration is None:
        measurement = measure_look(shots, slot_utc, site, None, None, learner, readings)
    else:
        with open_store_readonly(state) as store:
            given = site, calibration, store, learner, readings
            measurement = measure_look(shots, slot_utc, *given)
    return look_fields(slot_utc, measurement, shots, site, readings)


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


def say_look(look: dict[str, Any]) -> None:
    """Print a value and what lies behind it: main camera alone, the rig's motion, the frames."""
    row, seen = look["measurement"], look["seen"]
    say(f"{row['slot_utc']}  {_value(row)}")
    if row["spread_x_mm"] is not None:
        spread = f"x {row['spread_x_mm']:.3f} mm, y {row['spread_y_mm']:.3f} mm"
        say(f"spread       {spread}, of {row['frames_used']} pairs")
    if row["raw_x_mm"] is not None:
        say(f"raw          x {row['raw_x_mm']:+.3f} mm, y {row['raw_y_mm']:+.3f} mm")
    if row["rx_rad"] is not None:
        rx, ry, rz = (1e3 * row[name] for name in ("rx_rad", "ry_rad", "rz_rad"))
        tx, ty, tz = (row[name] for name in ("tx_mm", "ty_mm", "tz_mm"))
        say(f"rig rotation x {rx:+.4f}, y {ry:+.4f}, z {rz:+.4f} mrad")
        say(f"rig shift    x {tx:+.4f}, y {ty:+.4f}, z {tz:+.4f} mm")
    for target in row.get("targets", []):  # an older dcamd gives none
        say(f"{target['name']:<12} {target['role']}, {_value(target)}")
    say(f"seen         {seen['discs']} discs, {seen['corners']} corners")
    for reading in look.get("readings", []):
        value = reading["value"]
        said = f"none: {reading['cause']}" if value is None else f"{value:g} {reading['unit']}"
        say(f"{reading['name']:<12} {said}")
    for problem in look.get("problems", []):  # an older dcamd gives none
        say(f"problem      {problem}")
    if Reason.NO_CALIBRATION in row["reasons"]:
        say(f"next         {_TO_CALIBRATE}")
    skew = "not measured" if look["skew_s"] is None else f"{1e3 * look['skew_s']:+.2f} ms"
    say(f"skew         {skew}")
    for name in ("main", "sub"):
        say(f"{name:<12} {frame_text(look[name])}")


def _value(row: dict[str, Any]) -> str:
    """A displacement, or why there is none, in a few words; as `daemon.value_text`."""
    why, flag = "+".join(row["reasons"]), Flag(row["flag"])
    if row["x_mm"] is None:
        return f"no value ({flag.name.lower()}: {why})"
    text = ", ".join(
        f"{axis} {row[f'{axis}_mm']:+.3f} ± {row[f'sigma_{axis}_mm']:.3f} mm" for axis in "xy"
    )
    return text if flag is Flag.GOOD else f"{text} (suspect: {why})"
