"""`dcam-ctl preview`: what both cameras see, live, for whoever aims and focuses them."""

from __future__ import annotations

from contextlib import ExitStack, closing, suppress

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note, say
from daemon.control.control_socket import cameras_to_oneself
from daemon.devices import open_clock, open_pair_source
from drivers.errors import DeviceError
from drivers.protocols import Role


@click.command(
    "preview",
    epilog="\b\nExample:\n  dcam-ctl preview\n"
    "  ssh -L 8765:localhost:8765 pier-3 dcam-ctl preview    then http://localhost:8765/aim",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8765,
    show_default=True,
    metavar="PORT",
    help="Of the page; 0 takes any that is free.",
)
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(0.1, 60.0),
    default=1.0,
    show_default=True,
    metavar="SECONDS",
    help="From one pair to the next.",
)
@click.option("--looks", type=click.IntRange(min=1), metavar="N", help="End after N pairs.")
@common_options
@pass_options
def command(options: Options, port: int, interval_s: float, looks: int | None) -> None:
    """Show both cameras live, until Ctrl-C: pictures, focus figure, histogram, target found or not.

    One line a look on the terminal, and a page with the pictures on this machine's loopback
    address; from elsewhere look through an SSH tunnel. Nothing is recorded. A running dcamd pauses
    meanwhile, its slots are a gap `calibration`, and goes on by itself. With `[exposure] mode =
    "auto"` exposure follows the light from look to look.
    """
    from daemon.preview.shown import Shown
    from daemon.preview.snapshot import Snapshot, take_snapshot
    from daemon.slots.exposure import loop_of
    from daemon.web.app import build_app
    from daemon.web.serving import serving
    from daemon.web.settings import Settings, cache_directory

    config = options.config
    clock, site = open_clock(config), config.site()
    loop = loop_of(config)
    shown = Shown(config.name)
    best: dict[Role, float] = {"main": 0.0, "sub": 0.0}

    def line(look: Snapshot) -> str:
        parts = []
        for role, seen in look.cameras.items():
            best[role] = max(best[role], seen.focus)
            blur = "" if seen.blur_px is None else f", edges {seen.blur_px:.2f} px"
            parts.append(
                f"{role}: {seen.found}{blur}, focus {seen.focus:.4f} (best {best[role]:.4f}), "
                f"brightest {seen.brightest:.0%}"
            )
            parts += (f"{further.name}: {further.text}" for further in seen.further)
        return " | ".join(parts)

    with suppress(KeyboardInterrupt), ExitStack() as opened:
        opened.enter_context(cameras_to_oneself(options.state, "dcam-ctl preview"))
        source = opened.enter_context(closing(open_pair_source(config, clock)))
        settings = Settings(options.installation, cache_directory(options.state))
        page = build_app(settings, shown)
        bound = opened.enter_context(serving(page, "127.0.0.1", port, "give another --port"))
        note(f"http://localhost:{bound}/aim shows the pictures; Ctrl-C ends")
        taken = 0
        while looks is None or taken < looks:
            taken += 1
            slot_utc = clock.now_utc().replace(microsecond=0)
            try:
                pair = source.capture(slot_utc)
                look = take_snapshot(pair, site, clock.now_utc())
                if loop is not None:
                    loop.follow(source, [pair])
            except DeviceError as error:
                shown.tell(str(error))
                say(f"no pair: {error}", now=True)
            else:
                shown.show(look)
                say(line(look), now=True)
            clock.pause(interval_s)
