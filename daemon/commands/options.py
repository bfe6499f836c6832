"""Options that the commands share: which config, which state, which span of time."""

from __future__ import annotations

import difflib
import errno
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from daemon.commands.durations import duration_s
from daemon.commands.output import ZONE, note, progress, shown_zone
from daemon.errors import HardwareError, UsageError
from daemon.file_errors import file_error_text
from daemon.zones import find_zone

if TYPE_CHECKING:  # help and the fleet's list do not wait for what a site's config needs
    from daemon.config.centre import Centre
    from daemon.config.reading import Config, Installation

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(slots=True)
class Options:
    """What was said on the command line, before and after the command's name."""

    config_flag: Path | None = None
    state_flag: Path | None = None
    site: str | None = None
    """A site of the central database, instead of this computer's own."""
    _found: Installation | None = field(default=None, repr=False)

    @property
    def installation(self) -> Installation:
        """Config and state directory, read once: flag > environment > file > default.

        Raises ConfigError, HardwareError.
        """
        if self._found is None:
            from daemon.config.reading import find_installation

            if self.site is None:
                found = find_installation(self.config_flag, self.state_flag)
            else:
                found = self._of_site()
            _require_usable(found.state_directory)
            self._found = found
        return self._found

    @property
    def centre(self) -> Centre:
        """What reads the central database: no site of this computer is needed.

        Raises ConfigError.
        """
        from daemon.config.centre import load_centre
        from daemon.config.file import find_config

        return load_centre(find_config(self.config_flag))

    def _of_site(self) -> Installation:
        """The site's config and a copy of its record, from the central database."""
        from daemon.config.reading import Installation, load_config
        from daemon.fleet.site import fetch

        if self.state_flag is not None:
            msg = "--site reads the central database: leave out --state"
            raise UsageError(msg)
        with progress(None, f"fetching rows of {self.site}") as steps:
            fetched = fetch(self.centre.fleet, str(self.site), steps.at)
        return Installation(fetched.config, load_config(fetched.config), fetched.state)

    @property
    def config(self) -> Config:
        """The checked config. Raises ConfigError."""
        return self.installation.config

    @property
    def state(self) -> Path:
        """The state directory: database and frames.

        Where it is named, no config is needed to find it: a copied state can be read anywhere.
        """
        named = self.state_flag or os.environ.get("DCAM_STATE")
        if not named or self.site is not None:
            return self.installation.state_directory
        state = Path(named).absolute()
        _require_usable(state)
        return state

    def zone(self, named: str | None) -> tzinfo:
        """The zone in which people read times: as named, else [site] timezone, else UTC.

        A config that is missing or wrong elsewhere is no obstacle. Raises ValueError.
        """
        if named is not None:
            return find_zone(named)
        from daemon.config.alarm import read_remains
        from daemon.config.file import find_config

        path = find_config(self.config_flag)
        remains = read_remains(path)
        if remains is None or remains.site.timezone is None:
            return UTC
        try:
            return find_zone(remains.site.timezone)
        except ValueError as error:
            msg = f"{path}: site.timezone: {error}"
            raise ValueError(msg) from None


def _require_usable(state: Path) -> None:
    """Raise HardwareError for a state directory that is there but cannot be looked into."""
    try:
        if not stat.S_ISDIR(state.stat().st_mode):
            msg = f"{state}: not a directory; name another --state"
            raise HardwareError(msg)
    except FileNotFoundError:
        return  # whoever writes first makes it
    except OSError as error:
        raise HardwareError(file_error_text(error)) from error
    if not os.access(state, os.R_OK | os.X_OK):
        denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(state))
        raise HardwareError(file_error_text(denied))


class SuggestingGroup(click.Group):
    """A group that suggests the nearest command where the name is mistyped."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command. Raises click.UsageError with the nearest names."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx), n=3)
            if not near:
                raise
            names = " or ".join(f"'{name}'" for name in near)
            msg = f"No such command {args[0]!r}. Did you mean {names}?"
            raise click.UsageError(msg, ctx) from None


pass_options = click.make_pass_decorator(Options, ensure=True)


def common_options(function: Function) -> Function:
    """Add `--config`, `--state` and `--debug`; the first two end in the context's `Options`.

    Click does not look whether the paths can be read: that is no mistake of usage.
    """
    for add in (
        click.option(
            "--debug",
            is_flag=True,
            expose_value=False,
            help="Show where an error came from.",
        ),
        click.option(
            "--state",
            "state_flag",
            type=click.Path(path_type=Path, readable=False),
            metavar="DIR",
            callback=_keep,
            expose_value=False,
            is_eager=True,
            help="Database and frames; else $DCAM_STATE, else [storage] directory.",
        ),
        click.option(
            "--config",
            "config_flag",
            type=click.Path(path_type=Path, readable=False),
            metavar="FILE",
            callback=_keep,
            expose_value=False,
            is_eager=True,  # it says in which zone times are given
            help="The config; else $DCAM_CONFIG, else /etc/dcam/dcam.toml.",
        ),
    ):
        function = add(function)
    return function


def _keep(ctx: click.Context, parameter: click.Parameter, value: Any) -> None:
    if value is not None and parameter.name is not None:
        setattr(ctx.ensure_object(Options), parameter.name, value)


site_option = click.option(
    "--site",
    metavar="NAME",
    callback=_keep,
    expose_value=False,
    is_eager=True,
    help="Read this site from the central database of [fleet], as of its last sync.",
)


def only_reading_site(ctx: click.Context) -> None:
    """Raise UsageError for a site of the central database before a command that enters something.

    What is entered belongs into the pier's own record, which is the truth.
    """
    if ctx.ensure_object(Options).site is not None:
        msg = (
            f"--site only reads: enter at the pier itself, or, to read, give --site behind "
            f"{ctx.invoked_subcommand}"
        )
        raise UsageError(msg)


json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object, for programs."
)

with_excluded_option = click.option(
    "--with-excluded", is_flag=True, help="Take in what the quality ledger excludes."
)


def tz_option(function: Function) -> Function:
    """Add `--tz ZONE`: times that people read and give are in this zone.

    `say`, `note` and `print_table` write them so by themselves, and `shown_zone` gives it to what
    draws and writes pages. JSON and files for programs stay UTC.
    """
    return click.option(
        "--tz",
        callback=_keep_zone,
        expose_value=False,
        is_eager=True,  # before the times that are given in it
        metavar="ZONE",
        help="Write and read times in this zone: Europe/Berlin, local, UTC; else [site] timezone, "
        "else UTC. JSON and tables for programs stay UTC.",
    )(function)


def _keep_zone(ctx: click.Context, parameter: click.Parameter, name: str | None) -> None:
    if name is None and ZONE in ctx.meta:
        return  # said to the group
    try:
        ctx.meta[ZONE] = ctx.ensure_object(Options).zone(name)
    except ValueError as error:
        if name is not None:
            raise click.BadParameter(str(error), ctx, parameter) from None
        note(f"{error}; times are UTC")  # an alarm must not fail for want of a zone


def at_option(function: Function) -> Function:
    """Add `--at TIME`; the command gets it as `at_utc`, or None for now."""
    return click.option(
        "--at",
        "at_utc",
        callback=utc_time,
        metavar="TIME",
        help="Judge as of this time; default: now.",
    )(function)


def output_option(function: Function) -> Function:
    """Add `--output FILE`; the command gets a path, or None for stdout."""
    return click.option(
        "--output",
        type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
        metavar="FILE",
        default="-",
        show_default=True,
        callback=lambda _ctx, _parameter, path: None if str(path) == "-" else path,
        help="Where to write; - is stdout.",
    )(function)


def utc_time(_ctx: click.Context, _parameter: click.Parameter, text: str | None) -> datetime | None:
    """Read a time: ISO 8601, a date, or how long ago (`90m`, `24h`, `30d`); give it in UTC.

    A time without an offset is in the zone of `--tz`, which is UTC unless somebody chose another;
    of two that a clock shows as it goes back it is the first. Raises click.BadParameter.
    """
    if text is None:
        return None
    if (ago_s := duration_s(text)) is not None:
        return datetime.now(UTC) - timedelta(seconds=ago_s)
    try:
        when = datetime.fromisoformat(text.strip())
    except ValueError:
        msg = (
            f"{text!r} is not a time; write 2026-03-01, 2026-03-01T06:00:00Z, or 24h for "
            "24 hours ago"
        )
        raise click.BadParameter(msg) from None
    try:
        return (when.replace(tzinfo=shown_zone()) if when.tzinfo is None else when).astimezone(UTC)
    except OverflowError:
        msg = f"{text!r} is too far from today"
        raise click.BadParameter(msg) from None


def _span_end(ctx: click.Context, parameter: click.Parameter, text: str | None) -> datetime | None:
    """Read one end of a span; whichever is read second must fit the first."""
    when = utc_time(ctx, parameter, text)
    ends = {**ctx.params, parameter.name: when}
    since, until = ends.get("since"), ends.get("until")
    if since and until and since > until:
        msg = f"--since {since:%Y-%m-%dT%H:%M:%SZ} is later than --until {until:%Y-%m-%dT%H:%M:%SZ}"
        raise click.UsageError(msg, ctx)
    return when


def span_options(function: Function) -> Function:
    """Add `--since` and `--until`, in this order, and `--tz`, in which they may be given."""
    until = click.option(
        "--until",
        callback=_span_end,
        metavar="TIME",
        help="Before this time; default: no end.",
    )
    since = click.option(
        "--since",
        callback=_span_end,
        metavar="TIME",
        help="From this time on: 2026-03-01, 2026-03-01T06:00:00Z, 24h, 30d.",
    )
    return since(until(tz_option(function)))
