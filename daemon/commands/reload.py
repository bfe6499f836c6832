"""`dcam-ctl reload`: have the running dcamd read its config again."""

from __future__ import annotations

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note
from daemon.control.control_socket import ask_daemon
from daemon.errors import HardwareError


@click.command("reload", epilog="\b\nExample:\n  dcam-ctl check && dcam-ctl reload")
@common_options
@pass_options
def command(options: Options) -> None:
    """Have the running dcamd read its config again; it goes on with it after the slot in progress.

    A config that is wrong leaves the old one in force, and is reported here: exit code 3. The
    cameras are opened again; slots that this costs are a gap. `[storage] directory` and a simulated
    clock need a restart.
    """
    state = options.state
    if ask_daemon(state, "reload") is None:
        msg = f"no dcamd runs on {state}; systemctl start dcamd"
        raise HardwareError(msg)
    note("dcamd goes on with the new config after the slot in progress")
