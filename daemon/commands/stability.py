"""`dcam-ctl stability`: how far the rig moves by itself, by what the fixed targets showed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import pairwise
from typing import TYPE_CHECKING

import click

from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    pass_options,
    site_option,
    span_options,
)
from daemon.commands.output import note, print_json, print_table, progress, say
from daemon.errors import WorkFailedError
from daemon.store.database import ALWAYS, NEVER, Store, open_store_readonly

if TYPE_CHECKING:
    from core.calibration.calibrate import Calibration
    from core.rig.learning import Estimate, RigFit, TargetHours
    from core.site import Site

_NARROWER = 0.5
"""Of what the config allows, below which less would do."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """One quantity of the record against the config."""

    name: str
    unit: str
    shown: Estimate | None
    """None: this record does not tell."""
    allowed: float
    text: str


@click.command("stability", epilog="\b\nExample:\n  dcam-ctl stability --since 90d")
@span_options
@json_option
@site_option
@common_options
@pass_options
def command(
    options: Options, since: datetime | None, until: datetime | None, as_json: bool
) -> None:
    """Estimate the stability budget from what fixed targets showed, and compare the config's.

    Their closures are fitted, hour by hour, with the main camera's temperature, creep and noise.
    Prints what the record shows with its 1 sigma, a verdict, and lines for `[stability]`. Needs a
    fixed target, a week of rows with the camera's temperature, and a change of temperature.
    """
    from core.rig.learning import fit_rig
    from daemon.store.queries.closure_hours import read_closure_hours

    site = options.config.site()
    with open_store_readonly(options.state) as store:
        calibrations = _usable(store)
        with progress(None, "reading rows") as steps:
            read = read_closure_hours(store.path, since or ALWAYS, until or NEVER, steps.at)
    references_s = {k: c.reference.utc_s for k, c in calibrations.items() if c.reference}
    hours = read.of(references_s, _distances(calibrations))
    _require_enough(hours, has_closure=bool(read.closure), state=str(options.state))
    fits = {str(k): fit_rig(one) for k, one in _each(hours).items()}
    joined = fit_rig(hours)
    verdicts = _verdicts(site, _scale(calibrations), joined)
    lines = _config_lines(site, verdicts)
    turns = list(_turns(calibrations))
    if as_json:
        print_json(
            {
                "command": "stability",
                "calibrations": {k: _fields(fit) for k, fit in fits.items()},
                "joined": _fields(joined),
                "verdicts": [asdict(verdict) for verdict in verdicts],
                "calibrated_turns": turns,
                "stability": dict(lines),
            }
        )
        return
    _print_fits(fits | ({"together": joined} if len(fits) != 1 else {}))
    say()
    for verdict in verdicts:
        say(verdict.text)
    say(_lag_text(joined))
    if joined.air_k_per_m is None:
        say(
            "not told apart with plates at one distance: a turn of the steel, a shift of the main "
            "camera's image, and the air. The lines below keep the config's shares."
        )
    for turn in turns:
        say(_turn_text(turn))
    say()
    say("[stability]")
    for key, value in lines:
        say(f"{key} = {value:g}")


def _usable(store: Store) -> dict[int, Calibration]:
    """Calibrations whose reference has its time; the others are named on stderr."""
    from core.errors import CalibrationError

    found = {}
    for record in store.calibrations():
        try:
            calibration = record.calibration
        except CalibrationError as error:
            note(f"calibration {record.id} left out: {error}")
            continue
        if calibration.reference is None:
            note(f"calibration {record.id} left out: the time of its reference is not known")
        elif record.id is not None:
            found[record.id] = calibration
    return found


def _distances(calibrations: Mapping[int, Calibration]) -> dict[str, float]:
    """Distance (mm) of each fixed target, as the newest calibration has it."""
    return {
        target.name: target.distance_mm
        for calibration in calibrations.values()
        for target in calibration.calibrated.further
        if target.is_fixed
    }


def _scale(calibrations: Mapping[int, Calibration]) -> float:
    from core.rig.stability import main_scale

    newest = calibrations[max(calibrations)]
    return main_scale(newest.calibrated.B)


def _require_enough(hours: TargetHours, *, has_closure: bool, state: str) -> None:
    """Raise WorkFailedError with what is missing."""
    import numpy as np

    from core.rig.learnt import FEWEST_DAYS, FEWEST_HOURS, LEAST_K

    if not has_closure or not len(hours.distance_mm):
        missing = (
            "no row with a good fixed target and the camera's temperature; hang one "
            "([[target.extra]], role fixed) and calibrate with it in view"
        )
        raise WorkFailedError(_said(state, missing))
    seen = hours.seen
    days = float(np.ptp(hours.days[seen])) if seen.any() else 0.0
    warmth = float(np.ptp(hours.warmth_k[seen])) if seen.any() else 0.0
    if days < FEWEST_DAYS or seen.sum() < FEWEST_HOURS:
        missing = (
            f"a fixed target was seen in {int(seen.sum())} hours of {days:.1f} days: needs "
            f"{FEWEST_HOURS} hours within {FEWEST_DAYS:.0f} days or more"
        )
        raise WorkFailedError(_said(state, missing))
    if warmth < LEAST_K:
        missing = f"the camera's temperature changed by {warmth:.1f} K only: needs {LEAST_K}"
        raise WorkFailedError(_said(state, f"{missing} K"))


def _said(state: str, missing: str) -> str:
    return f"{state}: {missing}"


def _each(hours: TargetHours) -> dict[int, TargetHours]:
    """The hours of each calibration that has enough of its own."""
    import numpy as np

    from core.rig.learnt import FEWEST_HOURS

    seen = hours.seen
    numbers = [int(number) for number in np.unique(hours.calibration)]
    return {
        number: hours.part(hours.calibration == number)
        for number in numbers
        if (seen & (hours.calibration == number)).sum() >= FEWEST_HOURS
    }


def _verdicts(site: Site, scale_px_per_mm: float, fit: RigFit) -> list[Verdict]:
    from core.rig.learning import allowed_urad_per_k

    budget = site.stability
    creep = math.hypot(budget.cameras_urad_per_sqrt_day, budget.board_urad_per_sqrt_day)
    per_k = allowed_urad_per_k(site, scale_px_per_mm)
    return [
        _verdict("turning with temperature", "urad/K", fit.urad_per_k, per_k),
        _verdict("creep", "urad/sqrt(day)", fit.urad_per_sqrt_day, creep),
        _verdict("air's gradient", "K/m", fit.air_k_per_m, budget.air_gradient_k_per_m),
    ]


def _verdict(name: str, unit: str, shown: Estimate | None, allowed: float) -> Verdict:
    if shown is None:
        text = f"{name}: this record does not tell it; the config allows {allowed:.3g} {unit}"
        return Verdict(name, unit, None, allowed, text)
    says = (
        f"{name}: the record shows {shown.value:.2g} ± {shown.sigma:.1g} {unit}, the config "
        f"allows {allowed:.2g}"
    )
    if shown.value - shown.sigma > allowed:
        advice = "widen it"
    elif shown.value + shown.sigma < _NARROWER * allowed:
        advice = "less would do"
    else:
        advice = "leave it"
    return Verdict(name, unit, shown, allowed, f"{says}: {advice}")


def _config_lines(site: Site, verdicts: Sequence[Verdict]) -> list[tuple[str, float]]:
    """The keys that the record tells of, each with its share of the whole as in the config."""
    keys = (
        (
            "cameras_urad_per_k",
            "board_urad_per_k",
            "board_expansion_per_k",
            "main_px_per_k",
            "sub_px_per_k",
        ),
        ("cameras_urad_per_sqrt_day", "board_urad_per_sqrt_day"),
        ("air_gradient_k_per_m",),
    )
    lines = []
    for verdict, names in zip(verdicts, keys, strict=True):
        if verdict.shown is None:
            continue
        wanted = math.hypot(verdict.shown.value, verdict.shown.sigma)
        values = [float(getattr(site.stability, name)) for name in names]
        if verdict.allowed > 0.0:
            values = [value * wanted / verdict.allowed for value in values]
        else:
            values = [wanted, *values[1:]]
        lines += [(name, float(f"{v:.2g}")) for name, v in zip(names, values, strict=True)]
    return lines


def _turns(calibrations: Mapping[int, Calibration]) -> Iterator[dict[str, object]]:
    """How the rig's angles changed from calibration to calibration, with the sigma of that."""
    import numpy as np

    from core.rig.rigid import Rig

    numbers = sorted(calibrations)
    for before, after in pairwise(numbers):
        old, new = (calibrations[number].calibrated for number in (before, after))
        if not (isinstance(old.model, Rig) and isinstance(new.model, Rig)):
            continue
        sigmas = [one.posterior.model_sigma[:3] for one in (old, new)]
        turn = -old.model.deviation_from(new.model)[:3]
        yield {
            "from": before,
            "to": after,
            "turn_urad": (1e6 * np.abs(turn)).tolist(),
            "sigma_urad": (1e6 * np.hypot(*sigmas)).tolist(),
        }


def _turn_text(turn: Mapping[str, object]) -> str:
    import numpy as np

    urad, sigma = (np.asarray(turn[key], dtype=float) for key in ("turn_urad", "sigma_urad"))
    each = ", ".join(
        f"{name} {u:.0f} ± {s:.0f}"
        for name, u, s in zip(("pitch", "yaw", "roll"), urad, sigma, strict=True)
    )
    said = "more than their sigma allows" if (urad > 3.0 * sigma).any() else "within their sigma"
    return (
        f"calibrations {turn['from']} and {turn['to']}: the rig's angles differ by {each} urad, "
        f"{said}"
    )


def _lag_text(fit: RigFit) -> str:
    if fit.lag_h == 0.0:
        return "warming and cooling: no difference is shown"
    return (
        f"warming and cooling differ: the rig follows the camera's temperature about "
        f"{fit.lag_h:.0f} h later; the coefficients are for the temperature so delayed"
    )


def _fields(fit: RigFit) -> dict[str, object]:
    return {
        "hours": fit.hours,
        "lag_h": fit.lag_h,
        "urad_per_k": asdict(fit.urad_per_k),
        "urad_per_sqrt_day": asdict(fit.urad_per_sqrt_day),
        "air_k_per_m": None if fit.air_k_per_m is None else asdict(fit.air_k_per_m),
        **{
            axis: {
                "urad_per_k": asdict(one.urad_per_k),
                "urad_per_sqrt_day": asdict(one.urad_per_sqrt_day),
                "noise_urad": one.noise_urad,
            }
            for axis, one in zip("xy", fit.axes, strict=True)
        },
    }


def _print_fits(fits: Mapping[str, RigFit]) -> None:
    def said(estimate: Estimate) -> str:
        return f"{estimate.value:.2f} ± {estimate.sigma:.2f}"

    print_table(
        ("calibration", "hours", "x urad/K", "y urad/K", "x urad/√day", "y urad/√day"),
        [
            (
                name,
                str(fit.hours),
                *(said(axis.urad_per_k) for axis in fit.axes),
                *(said(axis.urad_per_sqrt_day) for axis in fit.axes),
            )
            for name, fit in fits.items()
        ],
    )
