"""`dcam-ctl`, the engineer's tool: options that every command has, and the table of commands.

A command's module is loaded only when that command runs: `status` is asked every minute by a
monitoring system, and must not wait for the numerics.
"""

from __future__ import annotations

import gc
import importlib
import sys
import traceback
from collections.abc import Sequence
from typing import Any

import click

from daemon.commands.options import Options, SuggestingGroup, common_options
from daemon.error_report import run

COMMANDS = {
    "check": "Check config, state and clock; with --hardware cameras too.",
    "plan": "Predict what a site will see and how well it will measure.",
    "target": "Printable PDF of both targets at true scale.",
    "calibrate": "Calibrate from a frame set or with the pan-tilt head.",
    "datum": "The record's one zero, from calibration to calibration.",
    "stability": "How far the rig moves by itself, as its record shows, for [stability].",
    "preview": "Both cameras live, for aiming and focusing.",
    "capture": "Take and measure one pair now, beside dcamd too, and print it.",
    "reload": "Let the running dcamd read its config again.",
    "status": "Last value, cameras, coverage, gaps, disk; Nagios exit codes.",
    "alarm": "Send people what status finds wrong; run by a timer.",
    "metrics": "What status knows, for Prometheus.",
    "gaps": "List slots without a measurement, and why.",
    "ledger": "What people say of spans of the record: notes, exclusions.",
    "export": "Write measurements as a table.",
    "send": "Pass rows on to MQTT and InfluxDB, each once.",
    "sync": "Copy the record to the central database of many piers.",
    "archive": "Write closed months of many piers as Parquet.",
    "analyse": "Days, temperature, trend, steps and creep, with confidence.",
    "plot": "Draw a figure of the record, PNG or SVG.",
    "report": "Write the record of a span for the client, HTML or PDF.",
    "compare": "Hold the record against levelling, LiDAR or a model.",
    "backup": "Copy the database while the daemon runs.",
    "redate": "Correct the times of what was taken under a wrong clock.",
    "verify": "Read everything that was recorded, and check it.",
    "reprocess": "Measure kept frames or a frame set again.",
    "simulate": "Your site with simulated cameras; a head on a serial port.",
    "demo": "The whole system on a simulated rig, against the known truth.",
}
"""Name and one line of each command, in the order of `--help`; code in `daemon.commands.<name>`."""


class Commands(SuggestingGroup):
    """A group that imports a command's module when the command is wanted."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Give the names in the order an engineer meets them."""
        del ctx
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; None for a name that is none."""
        del ctx
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f"daemon.commands.{cmd_name}").command
        return command if isinstance(command, click.Command) else None

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run; an error of `status` is printed as a monitoring system reads it."""
        try:
            return super().main(*args, **extra)
        except BrokenPipeError:
            raise
        except Exception as error:
            words = extra.get("args") or sys.argv[1:]
            if _command(words) != "status":
                raise
            if "--debug" in words:
                traceback.print_exception(error, file=sys.stderr)
            status = importlib.import_module("daemon.commands.status")
            return status.tell_failure(error, as_json="--json" in words)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the table of commands without importing them."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(
    cls=Commands,
    no_args_is_help=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="\b\nExample:\n  dcam-ctl --config dcam.toml status\n  dcam-ctl calibrate --help",
)
@click.version_option(package_name="dcam", prog_name="dcam-ctl")
@common_options
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Operate a dual-camera bridge displacement system.

    Options may stand before or after the command. Times are UTC unless --tz says otherwise.

    Exit codes: 0 done, 1 the work failed, 2 usage, 3 config, 4 hardware or I/O, 5 database;
    those of status: 0 OK, 1 warning, 2 critical, 3 unknown.
    """
    ctx.ensure_object(Options)
    if ctx.invoked_subcommand != "status":  # it reads, and logs nothing: nor does it load a logger
        from daemon.log import configure_log

        configure_log(level="warning")


def main() -> int:
    """Run `dcam-ctl` and give its exit code."""
    code = run(cli, "dcam-ctl")
    gc.freeze()  # the process ends: a last search for cycles would take a fifth of `status`'s time
    return code


def _command(words: Sequence[str]) -> str | None:
    """Which command is meant; the command line may be wrong, so click cannot be asked."""
    return next((word for word in words if word in COMMANDS), None)


if __name__ == "__main__":
    sys.exit(main())
