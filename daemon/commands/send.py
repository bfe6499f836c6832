"""`dcam-ctl send`: pass rows on to MQTT and InfluxDB, each once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from datetime import datetime
from types import FrameType
from typing import TYPE_CHECKING

import click

from daemon.commands.options import Options, common_options, pass_options, tz_option, utc_time
from daemon.commands.output import note, say
from daemon.config.reading import Config

if TYPE_CHECKING:
    from daemon.outputs.output import Output
    from daemon.outputs.sender import Sender


@click.command("send", epilog="\b\nExample:\n  dcam-ctl send\n  dcam-ctl send --again-since 30d")
@click.option(
    "--follow", is_flag=True, help="Go on with new rows, until stopped; a service runs this."
)
@click.option(
    "--only",
    type=click.Choice(["mqtt", "influx"]),
    help="Send to this one of the config's outputs.",
)
@click.option(
    "--again-since",
    callback=utc_time,
    metavar="TIME",
    help="Send again what was recorded from this slot on: to a new server, or after a new datum.",
)
@tz_option
@common_options
@pass_options
def command(options: Options, follow: bool, only: str | None, again_since: datetime | None) -> None:
    """Send rows to the broker of [mqtt] and the database of [influx], each once.

    In the order in which they were written, so that late rows are sent too. What a server has not
    acknowledged is sent again, after an outage of any length: how far each has come is kept in the
    state directory. Reads the database beside dcamd, and never makes it wait.
    """
    from daemon.outputs.sender import Sender

    outputs = [one for one in _outputs(options.config) if only in {None, one.name}]
    if not outputs:
        named = "[mqtt] host or [influx] url" if only is None else f"[{only}]"
        say(f"nowhere to send to: the config has no {named}")
        return
    senders = [Sender(options.state, output, again_since) for output in outputs]
    if follow:
        _follow(senders, options.config)
        return
    for sender in senders:
        note(f"{sender.output.name}: {sender.send_all()} rows sent")


def _outputs(config: Config) -> Iterator[Output]:
    if config.mqtt.host is not None:
        from daemon.outputs.mqtt import MqttOutput

        yield MqttOutput(config.mqtt, config.name, period_s=config.schedule.period_s)
    if config.influx.url is not None:
        from daemon.outputs.influx import InfluxOutput

        yield InfluxOutput(config.influx, config.name)


def _follow(senders: Sequence[Sender], config: Config) -> None:
    """Run each in a thread of its own until a signal: a server that is away keeps none waiting."""
    from daemon.log import configure_log

    configure_log(config.log.format, config.log.level)
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    for sender in senders:
        sender.stop = stop
    threads = [threading.Thread(target=one.follow, name=one.output.name) for one in senders]
    for thread in threads:
        thread.start()
    # Whoever breaks takes the others along: the service is started again.
    while all(thread.is_alive() for thread in threads):
        threads[0].join(1.0)
    stop.set()
    for thread in threads:
        thread.join()
