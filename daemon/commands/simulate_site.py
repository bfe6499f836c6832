"""`dcam-ctl simulate site`: one's own site with simulated cameras and head, for a trial."""

from __future__ import annotations

import shlex
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note, say
from daemon.config.reading import find_config, load_config
from daemon.durable import write_durable
from daemon.errors import ConfigError, ExitCode, UsageError

CONFIG = "dcam.toml"
STATE = "state"
_LEFT_OUT = (
    ("alarm", "urls"),
    ("alarm", "command"),
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
    "  dcam-ctl simulate site --config mine.toml --output /tmp/trial --clock system",
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
@common_options
@pass_options
def command(options: Options, directory: Path, clock: Literal["stepped", "system"]) -> int:
    """Write a copy of the config with simulated cameras and head, everything else as it is.

    So calibrate, dcamd and capture run on the site's own geometry before any hardware is there.
    [alarm] is left out: a trial notifies nobody. Ends with the commands to run next.
    """
    source = find_config(options.config_flag)
    load_config(source)  # what is wrong in it is the original's fault, and named there
    config = _target(directory)
    text = simulated(source, clock, datetime.now(UTC))
    directory.mkdir(parents=True, exist_ok=True)
    write_durable(config, text.encode())
    shutil.copymode(source, config)
    load_config(config)
    simulated_parts = f"simulated cameras and head, clock {clock}, nobody in [alarm]"
    note(f"{config}: as {source}, but {simulated_parts}; next:")
    _say_next(config, directory)
    return ExitCode.DONE


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
