"""`dcam-ctl calibrate`: from lens views and rig positions to a calibration, judged and stored."""

from __future__ import annotations

from pathlib import Path

import click

from core.calibration.calibrate import Method
from daemon.commands.calibrate_head import calibrate_on, calibrate_with_head, found_lens_views
from daemon.commands.calibrate_lens import calibrate_intrinsics
from daemon.commands.calibrate_result import judge_and_store
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.errors import UsageError
from daemon.lock import require_owner
from daemon.store.database import open_store


@click.command(
    "calibrate",
    epilog="\b\nExample:\n  dcam-ctl calibrate --pan-tilt --lens-views /data/lens-2026-03-01\n"
    "  dcam-ctl calibrate --from /data/calibration-2026-03-01 --accept",
)
@click.option(
    "--from",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Calibrate on a frame set: all its rows but those of role measure.",
)
@click.option(
    "--pan-tilt",
    is_flag=True,
    help="Move the head, take the views, keep them below the state directory, calibrate on them.",
)
@click.option(
    "--intrinsics",
    is_flag=True,
    help="Take lens views, the board in the hand, until they are enough; or judge those of --from.",
)
@click.option(
    "--lens-views",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="With --pan-tilt: a frame set whose lens views (role intrinsics) are used; else the "
    "latest that --intrinsics took.",
)
@click.option(
    "--without-lens-views",
    is_flag=True,
    help="With --pan-tilt: take no lens views; the lens is then known as drawn only.",
)
@click.option(
    "--fresh", is_flag=True, help="Begin from the start, not where a run was interrupted."
)
@click.option(
    "--method",
    type=click.Choice([method.value for method in Method]),
    default=Method.RIGID.value,
    show_default=True,
    help="rigid: rigid rig with survey priors; paper: the nine parameters of Lee et al. 2020.",
)
@click.option("--skew", is_flag=True, help="Let the sub-camera's axes be skew (gamma of Eq. 10).")
@click.option(
    "--board-untouched",
    is_flag=True,
    help="The board has stayed on the pier since the calibration before, although there are lens "
    "views since: then that calibration may tell the new zero.",
)
@click.option("--accept", is_flag=True, help="Make the result active without asking.")
@json_option
@common_options
@pass_options
def command(
    options: Options,
    directory: Path | None,
    pan_tilt: bool,
    intrinsics: bool,
    lens_views: Path | None,
    without_lens_views: bool,
    fresh: bool,
    method: str,
    skew: bool,
    board_untouched: bool,
    accept: bool,
    as_json: bool,
) -> int:
    """Calibrate lens, board and rig, say how far to trust the result, and store it.

    Views that are damaged or do not fit are left out and named. Motions that do not determine
    the model are refused, with the motion that is missing. Without --accept and without a
    terminal to ask on, the result becomes active only if it passed; exit code 1 if it did not.

    With --pan-tilt every view is kept as soon as it is taken: an interrupted run goes on where
    it broke off. A running dcamd pauses meanwhile, and its slots are a gap of that cause.
    """
    if not pan_tilt and (lens_views is not None or without_lens_views or fresh):
        msg = "--lens-views, --without-lens-views and --fresh go with --pan-tilt"
        raise UsageError(msg)
    if intrinsics and not pan_tilt:
        return calibrate_intrinsics(options.config, options.state, directory, as_json=as_json)
    if (directory is not None) == pan_tilt:
        msg = "give one of --from DIR, --pan-tilt, --intrinsics"
        raise UsageError(msg)
    config, state = options.config, options.state
    require_owner(state)
    with open_store(state) as store:  # first: what cannot be stored need not be taken
        if directory is not None:
            run, taken_utc = calibrate_on(config, directory, Method(method), skew=skew)
        else:
            run, taken_utc = calibrate_with_head(
                config,
                state,
                Method(method),
                skew=skew,
                lens=None if without_lens_views else found_lens_views(state, lens_views),
                needs_lens=not without_lens_views,
                fresh=fresh,
            )
        return judge_and_store(
            config,
            store,
            run,
            taken_utc,
            accept=accept,
            as_json=as_json,
            keeps_page=directory is None,
            board_untouched=board_untouched,
        )
