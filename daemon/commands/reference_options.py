"""Options of the commands that hold the record against a reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from daemon.commands.durations import duration_s

Function = TypeVar("Function", bound=Callable[..., Any])


def span_s(_ctx: click.Context, _parameter: click.Parameter, text: str | None) -> float | None:
    """Read a span of time, as `10m`, in seconds. Raises click.BadParameter."""
    if text is None:
        return None
    if (seconds := duration_s(text)) is not None:
        return seconds
    msg = f"{text!r} is not a span of time; write 90s, 10m, 6h or 2d"
    raise click.BadParameter(msg)


def reference_options(*, required: bool = False) -> Callable[[Function], Function]:
    """Add `--reference`, `--zero` and `--window`: `reference`, `zero`, `window_s`."""

    def decorate(function: Function) -> Function:
        for add in (
            click.option(
                "--window",
                "window_s",
                callback=span_s,
                default="5m",
                show_default=True,
                metavar="SPAN",
                help="Rows within this of a time of the reference are averaged.",
            ),
            click.option(
                "--zero",
                type=click.Choice(["free", "fixed"]),
                default="free",
                show_default=True,
                help="free: the two systems have zeros of their own, the mean difference is taken "
                "off; fixed: they share one.",
            ),
            click.option(
                "--reference",
                type=click.Path(path_type=Path),
                metavar="FILE",
                required=required,
                help="A CSV of what others measured: time, x_mm, y_mm, sigma_mm, point.",
            ),
        ):
            function = add(function)
        return function

    return decorate
