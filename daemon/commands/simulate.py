"""`dcam-ctl simulate`: a site or a pan-tilt head without hardware."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import click

from daemon.commands.options import SuggestingGroup, common_options
from daemon.commands.simulate_site import command as site
from daemon.errors import ExitCode, UsageError
from drivers.sim.head_machine import Faults, FaultyHead, HeadMachine
from drivers.sim.head_pelco import PelcoMachine, PelcoModel
from drivers.sim.head_ptu import PtuMachine, PtuModel
from drivers.sim.head_server import HeadServer


@click.group(
    "simulate",
    cls=SuggestingGroup,
    epilog="\b\nExample:\n  dcam-ctl simulate site --config mine.toml --output /tmp/trial\n"
    "  dcam-ctl simulate head --protocol ptu --link /tmp/head",
)
def command() -> None:
    """Try dcam without hardware: one's own site simulated, or a head on a serial port."""


command.add_command(site)


@command.command(
    "head",
    epilog="\b\nExample:\n"
    "  dcam-ctl simulate head --protocol ptu --link /tmp/head --angles /tmp/head.angles\n"
    "  dcam-ctl simulate head --protocol pelco-d --no-feedback --noise 0.2",
)
@click.option(
    "--protocol",
    type=click.Choice(["ptu", "pelco-d"]),
    required=True,
    help="ptu: ASCII of FLIR / Directed Perception; pelco-d.",
)
@click.option(
    "--link",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="A stable name for the port: a symbolic link, made and removed.",
)
@click.option(
    "--angles",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="Unix socket that tells simulated cameras where it is ([simulation] head_angles).",
)
@click.option(
    "--speed-factor",
    type=click.FloatRange(min=0, min_open=True),
    default=1.0,
    show_default=True,
    help="So many times faster than a real head.",
)
@click.option(
    "--speed",
    "speed_deg_s",
    type=click.FloatRange(min=0, min_open=True),
    default=6.0,
    show_default=True,
    help="Degrees a second; with Pelco-D that of level 63.",
)
@click.option(
    "--acceleration",
    "accel_deg_s2",
    type=click.FloatRange(min=0, min_open=True),
    default=12.0,
    show_default=True,
    help="Degrees a second squared.",
)
@click.option(
    "--arcsec-per-count",
    type=click.FloatRange(min=0.1, max=3600),
    default=23.142857,
    show_default=True,
    help="Resolution (ptu); a D46 in half steps has 185.1428.",
)
@click.option(
    "--address",
    type=click.IntRange(0, 255),
    default=1,
    show_default=True,
    help="Address (pelco-d).",
)
@click.option("--no-feedback", is_flag=True, help="Knows no positions, says nothing (pelco-d).")
@click.option("--short-answers", is_flag=True, help="Answers in five bytes, without FF (pelco-d).")
@click.option("--general-answers", is_flag=True, help="Answers each order in four bytes (pelco-d).")
@click.option("--leading-lf", is_flag=True, help="Begins each answer with a line feed (ptu).")
@click.option(
    "--limit-hit-at-move",
    type=click.IntRange(min=1),
    metavar="N",
    help="Says !P in the middle of the N-th move and stops (ptu); an axis is a move of its own.",
)
@click.option(
    "--jam-at-move",
    type=click.IntRange(min=1),
    metavar="N",
    help="Is blocked in the middle of the N-th move; an axis is a move of its own.",
)
@click.option(
    "--latency",
    "latency_s",
    type=click.FloatRange(min=0),
    default=0.0,
    help="Every answer comes so many seconds late.",
)
@click.option(
    "--noise",
    type=click.FloatRange(0, 1),
    default=0.0,
    help="Share of answers that a burst of random bytes comes before.",
)
@click.option(
    "--silent-after",
    type=click.IntRange(min=0),
    metavar="N",
    help="Says nothing more after N commands, but goes on moving.",
)
@click.option(
    "--nonsense-after",
    type=click.IntRange(min=0),
    metavar="N",
    help="Answers with random bytes after N commands.",
)
@click.option("--seed", type=int, default=1, help="Of all that is random.")
@common_options
def head(
    protocol: str,
    link: Path | None,
    angles: Path | None,
    speed_factor: float,
    **options: Any,
) -> int:
    """Simulate a pan-tilt head on a serial port; print the port's name, run until Ctrl-C."""
    if link is not None:
        require_free("--link", link, left_over=link.is_symlink() and _is_port(link.readlink()))
    if angles is not None:
        require_free("--angles", angles, left_over=angles.is_socket())
    faults = Faults(
        latency_s=options["latency_s"] * speed_factor,
        **{name: options[name] for name in ("noise", "silent_after", "nonsense_after", "seed")},
    )
    server = HeadServer(
        FaultyHead(_machine(protocol, options), faults),
        link=link,
        angles=angles,
        speed_factor=speed_factor,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.stop())
    try:
        print(server.port, flush=True)
        server.serve()
    finally:
        server.close()
    return ExitCode.DONE


def require_free(option: str, path: Path, *, left_over: bool) -> None:
    """Raise UsageError where a name cannot be made, or belongs to something else.

    left_over: the name of a simulated head that was killed before it could remove it.
    """
    if not path.parent.is_dir():
        msg = f"{option} {path}: there is no directory {path.parent}"
        raise UsageError(msg)
    if os.path.lexists(path) and not left_over:
        msg = f"{option} {path}: holds something else than a simulated head; give another name"
        raise UsageError(msg)


def _is_port(path: Path) -> bool:
    return path.parent == Path("/dev/pts")


def _machine(protocol: str, options: dict[str, Any]) -> HeadMachine:
    common = {name: options[name] for name in ("speed_deg_s", "accel_deg_s2", "jam_at_move")}
    if protocol == "ptu":
        return PtuMachine(
            PtuModel(
                arcsec_per_count=options["arcsec_per_count"],
                leading_lf=options["leading_lf"],
                limit_hit_at_move=options["limit_hit_at_move"],
                **common,
            )
        )
    return PelcoMachine(
        PelcoModel(
            address=options["address"],
            feedback=not options["no_feedback"],
            short_answers=options["short_answers"],
            general_answers=options["general_answers"],
            **common,
        )
    )
