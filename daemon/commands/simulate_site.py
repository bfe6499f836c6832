"""`dcam-ctl simulate site`: one's own site with simulated cameras and head, for a trial."""

from __future__ import annotations

import shlex
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note, say
from daemon.config.file import find_config
from daemon.config.reading import Config, load_config
from daemon.durable import write_durable
from daemon.errors import ConfigError, ExitCode, UsageError

if TYPE_CHECKING:  # the renderer is loaded by who writes a season
    from drivers.sim.season_writer import SeasonPlan

CONFIG = "dcam.toml"
STATE = "state"
_LEFT_OUT = (
    ("alarm", "urls"),
    ("alarm", "command"),
    ("alarm", "reading"),
    ("genicam", "producer"),
    ("replay", "directory"),
    ("simulation", "head_angles"),
)
"""Keys that a trial does not use: whom to tell, and paths beside the original."""
BEGIN_IN = timedelta(minutes=30)
"""On the machine's clock nothing moves for this long: time to calibrate."""


@click.command(
    "site",
    epilog="\b\nExample:\n  dcam-ctl simulate site --config mine.toml --output /tmp/trial\n"
    "  dcam-ctl simulate site --config mine.toml --output /tmp/trial --clock system\n"
    "  dcam-ctl simulate site --config mine.toml --output /tmp/year --season 365 --rebond",
)
@click.option(
    "--output",
    "directory",
    type=click.Path(path_type=Path),
    metavar="DIR",
    required=True,
    help="Where the config of the trial is written; its state goes below it.",
)
@click.option(
    "--clock",
    type=click.Choice(["stepped", "system"]),
    default="stepped",
    show_default=True,
    help="stepped: simulated time, a day passes in minutes; system: the machine's own time.",
)
@click.option(
    "--season",
    "days",
    type=click.FloatRange(min=0, min_open=True, max=36_500),
    metavar="DAYS",
    help="Also write a season of so many days as a frame set with its truth.csv.",
)
@click.option(
    "--rows",
    type=click.IntRange(min=2),
    default=14,
    show_default=True,
    help="Measure rows of the season.",
)
@click.option(
    "--rebond",
    is_flag=True,
    help="Half-way through the season the board is bonded again: a second calibration and set.",
)
@common_options
@pass_options
def command(
    options: Options,
    directory: Path,
    clock: Literal["stepped", "system"],
    days: float | None,
    rows: int,
    *,
    rebond: bool,
) -> int:
    """Write a copy of the config with simulated cameras and head, everything else as it is.

    So calibrate, dcamd and capture run on the site's own geometry before any hardware is there.
    [alarm] and [[reading]] are left out: a trial notifies nobody and has no sensors. Ends with the
    commands to run next.

    --season writes images instead of waiting for them: calibration and rows over months, as
    [simulation], [simulation.climate] and [simulation.breathing] have it.
    """
    source = find_config(options.config_flag)
    _require_possible(load_config(source))  # what is wrong in it is named there, not in the copy
    config = _target(directory)
    plan = season_plan(days, rows, rebond=rebond) if days is not None else None
    text = simulated(source, clock, datetime.now(UTC))
    directory.mkdir(parents=True, exist_ok=True)
    write_durable(config, text.encode())
    shutil.copymode(source, config)
    trial = load_config(config)
    parts = () if plan is None else write_season_of(trial, directory, plan)
    simulated_parts = f"simulated cameras and head, clock {clock}, nobody in [alarm]"
    note(f"{config}: as {source}, but {simulated_parts}; next:")
    if parts:
        _say_next_of_season(config, parts)
    else:
        _say_next(config, directory)
    return ExitCode.DONE


def _require_possible(config: Config) -> None:
    """Raise ConfigError for a site that cannot be simulated: a plate without a place."""
    from drivers.sim.world import World

    try:
        World(config.site(), config.simulation.settings(), renders=False)
    except ValueError as error:
        msg = f"{config.path}: {error}"
        raise ConfigError(msg) from None


def season_plan(days: float, rows: int, *, rebond: bool) -> SeasonPlan:
    """Give the plan of a season. Raises UsageError for more rows than fit."""
    from drivers.sim.season_writer import SeasonPlan

    try:
        return SeasonPlan(days, (rows - rows // 2, rows // 2) if rebond else (rows,))
    except ValueError as error:
        msg = f"--season {days:g} --rows {rows}: {error}; fewer rows or more days"
        raise UsageError(msg) from None


def write_season_of(config: Config, directory: Path, plan: SeasonPlan) -> tuple[Path, ...]:
    """Render a season of the config's simulation; give its frame sets, in time order."""
    from drivers.sim.season_writer import write_season

    return write_season(directory, config.site(), config.simulation.settings(), plan).parts


def simulated(source: Path, clock: str, now_utc: datetime) -> str:
    """Give the text of a config with its devices simulated; comments stay. Raises ConfigError."""
    import tomlkit
    from tomlkit.exceptions import ParseError

    try:
        document: Any = tomlkit.parse(source.read_text(encoding="utf-8-sig"))
    except ParseError as error:
        msg = f"{source}: cannot be copied: {error}; write the file in plainer TOML"
        raise ConfigError(msg) from None
    for role in ("main", "sub"):
        document["camera"][role]["backend"] = "simulated"
    _table(document, "pan_tilt")["backend"] = "simulated"
    _table(document, "storage")["directory"] = STATE
    simulation = _table(document, "simulation")
    simulation["clock"] = clock
    if clock == "system":
        begin_utc = now_utc.replace(microsecond=0) + BEGIN_IN
        simulation["start_utc"] = begin_utc
    for name, key in _LEFT_OUT:
        document.get(name, {}).pop(key, None)
    document.pop("reading", None)
    text: str = tomlkit.dumps(document)
    return text


def _table(document: Any, name: str) -> Any:
    import tomlkit

    if name not in document:
        document.add(tomlkit.nl())
        document.add(name, tomlkit.table())
    return document[name]


def _target(directory: Path) -> Path:
    """Give the path of the config to write. Raises UsageError where something is there."""
    config = directory / CONFIG
    if directory.exists() and not directory.is_dir():
        msg = f"--output {directory}: a file is there; name another directory"
        raise UsageError(msg)
    if config.exists() or config.is_symlink():
        msg = f"--output {directory}: holds a {CONFIG} already; name another directory"
        raise UsageError(msg)
    return config


def _say_next(config: Path, directory: Path) -> None:
    """Print the commands of a trial, ready to be pasted."""
    flag = f"--config {shlex.quote(str(config))}"
    say(f"dcam-ctl {flag} check")
    say(f"dcam-ctl {flag} calibrate --pan-tilt --accept")
    say(f"dcam-ctl {flag} capture")
    say(f"dcamd {flag} --max-slots 60")
    say(f"dcam-ctl {flag} plot --output {shlex.quote(str(directory / 'record.png'))}")


def _say_next_of_season(config: Path, parts: tuple[Path, ...]) -> None:
    flag = f"--config {shlex.quote(str(config))}"
    for part in parts:
        frames, table = shlex.quote(str(part)), shlex.quote(f"{part}.csv")
        say(f"dcam-ctl {flag} calibrate --from {frames} --accept")
        say(f"dcam-ctl {flag} reprocess --from {frames} --output {table}")
