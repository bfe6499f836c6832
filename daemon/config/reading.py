"""The config file `dcam.toml`, read and checked; what it may hold is in `model`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from daemon.config.alarm import alarm_problems
from daemon.config.file import find_config, find_state, read_toml
from daemon.config.model import BURST_SHARE, DEFAULT_STATE_DIRECTORY, Config
from daemon.config.plausibility import implausible_values
from daemon.config.problems import describe_problems
from daemon.config.readings import reading_problems
from daemon.config.simulation import SimulationSection
from daemon.config.web import web_problems
from daemon.errors import ConfigError
from daemon.zones import LOCAL, find_zone
from drivers.heads.port_name import port_problem

__all__ = [
    "DEFAULT_STATE_DIRECTORY",
    "Config",
    "Installation",
    "SimulationSection",
    "find_installation",
    "load_config",
]

_TAKEN_NAMES = frozenset({"main", "sub", "raw", "sigma", "closure", "spread", "reading"})
"""No further target's: the columns of its name would be others' columns."""


def load_config(path: Path) -> Config:
    """Read and check a config file. Raises ConfigError with one line for each problem."""
    return config_of(read_toml(path), path)


def config_of(data: Mapping[str, Any], path: Path) -> Config:
    """Check what a config file holds. Raises as `load_config`."""
    try:
        config = Config.model_validate(data, context={"directory": path.absolute().parent})
    except ValidationError as error:
        raise ConfigError(*describe_problems(error, Config, path)) from None
    problems = _contradictions(config) or implausible_values(config.site())
    if problems:
        raise ConfigError(*(f"{path}: {problem}" for problem in problems))
    config._path = path  # noqa: SLF001 - ours to fill in: a file does not name itself
    return config


def _contradictions(config: Config) -> list[str]:
    """Name values that are each allowed but do not go together."""
    problems = []
    extra = config.target.extra
    named = [("target.main", config.target.main)]
    named += [(f"target.extra[{number}]", target) for number, target in enumerate(extra)]
    for key, target in named:
        if len(target.diameter_mm) not in {1, len(target.centres_mm)}:
            problems.append(
                f"{key}.diameter_mm: {len(target.diameter_mm)} values for "
                f"{len(target.centres_mm)} centres; give one number or one for each disc"
            )
    names = [target.name for target in extra]
    for number, name in enumerate(names):
        if name in {*names[:number], *_TAKEN_NAMES}:
            problems.append(f'target.extra[{number}].name: "{name}" is taken; give another name')
    schedule = config.schedule
    if schedule.offset_s >= schedule.period_s:
        problems.append(
            f"schedule.offset_s: must be less than period_s = {schedule.period_s}, "
            f"is {schedule.offset_s}"
        )
    problems += _exposure_problems(config)
    problems += _burst_problems(config)
    problems += reading_problems(config)
    problems += alarm_problems(config)
    problems += web_problems(config.web)
    head = config.pan_tilt
    if head.port is not None and (problem := port_problem(head.port)):
        problems.append(f'pan_tilt.port: "{head.port}" {problem}')
    for axis, home, (low, high) in (
        ("pan", head.home_deg[0], head.pan_limits_deg),
        ("tilt", head.home_deg[1], head.tilt_limits_deg),
    ):
        if not low < high:
            problems.append(
                f"pan_tilt.{axis}_limits_deg: the lower limit first, is [{low:g}, {high:g}]"
            )
        elif not low < home < high:
            problems.append(
                f"pan_tilt.home_deg: {axis} {home:g} is not within {axis}_limits_deg = "
                f"[{low:g}, {high:g}]"
            )
    problems += config.simulation.problems(names)
    problems += config.mqtt.problems() + config.influx.problems() + config.fleet.problems()
    place = config.site_section
    if (place.latitude_deg is None) != (place.longitude_deg is None):
        problems.append(
            "site.latitude_deg: needs longitude_deg, and longitude_deg needs latitude_deg"
        )
    problems += _zone_problems(config.site_section.timezone)
    return problems


def _zone_problems(name: str | None) -> list[str]:
    """Name a zone that there is not; whether this computer has one matters to who reads times."""
    if name is None or name.lower() == LOCAL:
        return []
    try:
        find_zone(name)
    except ValueError as error:
        return [f"site.timezone: {error}"]
    return []


def _exposure_problems(config: Config) -> list[str]:
    """Name limits that are no limits, starts outside them, and frames that would not be awaited."""
    exposure = config.exposure
    problems = []
    timeout_s = config.trigger.timeout_s
    if exposure.longest_us / 1e6 >= timeout_s:
        problems.append(
            f"exposure: {exposure.longest_us:g} us are not over within trigger.timeout_s = "
            f"{timeout_s:g}; expose shorter or wait longer"
        )
    if exposure.mode == "fixed":
        return problems
    for name, start, (low, high) in (
        ("main_limits_us", exposure.main_us, exposure.main_limits_us),
        ("sub_limits_us", exposure.sub_us, exposure.sub_limits_us),
        ("main_gain_limits_db", exposure.main_gain_db, exposure.main_gain_limits_db),
        ("sub_gain_limits_db", exposure.sub_gain_db, exposure.sub_gain_limits_db),
    ):
        key = name.replace("_limits", "")
        if low > high or (low == high and name.endswith("_us")):
            problems.append(f"exposure.{name}: the lower limit first, is [{low:g}, {high:g}]")
        elif start is not None and not low <= start <= high:
            problems.append(f"exposure.{key}: {start:g} is not within {name} = [{low:g}, {high:g}]")
    return problems


def _burst_problems(config: Config) -> list[str]:
    """Name what keeps the pairs of a burst from being taken, one after the other, in their slot."""
    schedule, exposure = config.schedule, config.exposure
    if schedule.burst == 1:
        return []
    exposure_s = exposure.longest_us / 1e6
    if schedule.burst_spacing_s <= exposure_s:
        problem = (
            f"schedule.burst_spacing_s: must be longer than the exposure of {exposure_s:g} s, "
            f"is {schedule.burst_spacing_s:g}"
        )
        return [problem]
    last_s = (schedule.burst - 1) * schedule.burst_spacing_s
    needed_s = last_s + exposure_s + config.trigger.timeout_s
    room_s = BURST_SHARE * schedule.period_s
    if needed_s <= room_s:
        return []
    problem = (
        f"schedule.burst: {schedule.burst} pairs {schedule.burst_spacing_s:g} s apart may take "
        f"{needed_s:.3g} s with exposure and trigger.timeout_s, and have half of period_s = "
        f"{schedule.period_s}; take fewer, or closer together"
    )
    return [problem]


@dataclass(frozen=True, slots=True)
class Installation:
    """A config and the state directory that belongs to it."""

    config_path: Path
    config: Config
    state_directory: Path


def find_installation(
    config_flag: Path | None,
    state_flag: Path | None,
    environ: Mapping[str, str] = os.environ,
) -> Installation:
    """Settle which config and which state directory count: flag > environment > file > default.

    Raises ConfigError.
    """
    path = find_config(config_flag, environ)
    config = load_config(path)
    state = find_state(state_flag, config.storage.directory, environ)
    return Installation(config_path=path, config=config, state_directory=state)
