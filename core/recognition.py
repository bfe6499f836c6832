"""Both targets looked for by the config alone, and why one that is there is not recognised.

For calibrating, aiming and checking, where no calibration says what to expect. What is done to
explain costs time only where a target was not found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from core.checkerboard.board import Board
from core.checkerboard.board_mismatch import too_few_between_borders, turned
from core.checkerboard.corners import LocatedBoard, detect_board
from core.discs.disc_finder import Discs, find_discs
from core.discs.disc_mismatch import DiscMismatch, SeenDiscs, doubt_size, explain_discs
from core.discs.plates import WantedPlate, find_plates
from core.errors import BadLightError, NotRecognisedError, TargetNotFoundError, digits
from core.images import GreyImage, light_fault
from core.site import Site

_SWAP = (
    "the cameras are swapped: exchange camera.main.serial and camera.sub.serial in the config, or "
    "the columns main and sub of frames.csv"
)
_REVERSE = "switch ReverseX and ReverseY of the main camera off"
_SURVEY_SIGMAS = 3.0
"""A distance that the survey leaves so open is not doubted."""
_FOCAL_FACTOR = 2.0
"""A focal length that is off by more is another lens, or a board of other squares."""


def recognise_discs(image: GreyImage, site: Site) -> Discs:
    """Find the main target. Raises NotRecognisedError where something explains why it is not found.

    BadLightError in a black or overexposed image, else TargetNotFoundError.
    """
    try:
        discs = find_discs(image, site.main_target, site.nominal_px_per_mm)
    except TargetNotFoundError as error:
        why = _why_no_discs(image, site)
        if why is None:
            raise
        raise why from error
    if not discs.found.all():
        _require_no_better_way(image, site)
    return discs


def find_targets(image: GreyImage, site: Site) -> list[Discs | None]:
    """Find all targets of the main image, the main one first; None for one that is not seen.

    Raises TargetNotFoundError; does not say why one is not found.
    """
    if not site.extra_targets:
        return [find_discs(image, site.main_target, site.nominal_px_per_mm)]
    return find_plates(image, wanted_plates(site))


def recognise_targets(
    image: GreyImage, site: Site, before: Sequence[Discs | None] | None = None
) -> tuple[Discs, tuple[Discs | None, ...]]:
    """Find the main target and the further ones; None stands for a further one that is not seen.

    before is what an earlier image showed, the main target first. Raises as `recognise_discs`, and
    TargetNotFoundError where it is not certain which of two alike targets is which.
    """
    if not site.extra_targets:
        return recognise_discs(image, site), ()
    discs, *further = find_plates(image, wanted_plates(site, before))
    if discs is None:
        msg = "main target: not seen among the targets of the main image"
        raise _why_no_discs(image, site) or TargetNotFoundError(msg)
    return discs, tuple(further)


def wanted_plates(
    site: Site, before: Sequence[Discs | None] | None = None
) -> tuple[WantedPlate, ...]:
    """What is known of all targets of the main image before looking; before: an earlier image."""
    names = ["main target", *(f'target "{extra.name}"' for extra in site.extra_targets)]
    given = [None, *(extra.position_px for extra in site.extra_targets)]
    known = before or [None] * len(names)
    wanted = []
    for name, target, position, discs in zip(names, site.targets, given, known, strict=True):
        near = None if discs is None else discs.points_px
        rough = near is None and position is not None
        if rough:
            near = np.tile(np.asarray(position), (len(target.centres_mm), 1))
        scale = site.main.focal_px / target.distance_mm
        wanted.append(WantedPlate(name, target, scale, near, rough=rough))
    return tuple(wanted)


def _require_no_better_way(image: GreyImage, site: Site) -> None:
    """Raise NotRecognisedError if all discs fit another way, where only some do as configured."""
    seen = explain_discs(image, site.main_target)
    if seen is not None and seen.mismatch not in {DiscMismatch.SCALE, DiscMismatch.LAYOUT}:
        msg = f"main target: {_sentence(seen, site)}"
        raise NotRecognisedError(msg)


def recognise_board(image: GreyImage, site: Site) -> LocatedBoard:
    """Find the board, held in any way. Raises as `recognise_discs`."""
    try:
        return detect_board(image, Board.nominal(site.sub_target))
    except NotRecognisedError:
        raise
    except TargetNotFoundError as error:
        if _shows_discs(image, site):
            msg = f"sub target: the sub image shows the discs, not the board; {_SWAP}"
            raise NotRecognisedError(msg) from error
        dark = _light_error(image, "sub")
        if dark is None:
            raise
        raise dark from error


def recognise_mounted_board(image: GreyImage, site: Site) -> LocatedBoard:
    """Find the board as mounted, its WS origin top left. Raises as `recognise_discs`."""
    board, seen = Board.nominal(site.sub_target), recognise_board(image, site)
    if seen.fewer is None and seen.quarter_turns:
        raise turned(seen.quarter_turns, board)
    return seen


def disc_doubt(image: GreyImage, discs: Discs, site: Site) -> NotRecognisedError | None:
    """What lets the discs that were found seem to be wider, narrower, nearer or farther."""
    nominal, distance_mm = site.nominal_px_per_mm, site.main_target.distance_mm
    focused = distance_mm / (distance_mm - site.main.focal_length_mm)
    spread = math.exp(_SURVEY_SIGMAS * site.main_target.distance_sigma_mm / distance_mm)
    expected = nominal / spread, nominal * focused * spread
    seen = doubt_size(image, discs, site.main_target, expected)
    if seen is None:
        return None
    if seen.mismatch is DiscMismatch.DIAMETER:
        return NotRecognisedError(f"main target: {_diameter(seen, site)}")
    return NotRecognisedError(f"main target: {_other_scale(seen, site)}")


def board_doubt(seen: LocatedBoard, site: Site) -> NotRecognisedError | None:
    """What lets a board that was found seem to be another one, or partly covered."""
    if seen.fewer is None:
        return None
    return too_few_between_borders(seen.fewer[0], seen.fewer[1], Board.nominal(site.sub_target))


def _shows_discs(image: GreyImage, site: Site) -> bool:
    """Whether an image shows the whole main target, whatever its size."""
    try:
        return bool(find_discs(image, site.main_target).found.all())
    except TargetNotFoundError:
        return False


def _shows_board(image: GreyImage, site: Site) -> bool:
    try:
        detect_board(image, Board.nominal(site.sub_target))
    except NotRecognisedError:
        return True
    except TargetNotFoundError:
        return False
    return True


def _why_no_discs(image: GreyImage, site: Site) -> TargetNotFoundError | None:
    if _shows_board(image, site):
        msg = f"main target: the main image shows the board, not the discs; {_SWAP}"
        return NotRecognisedError(msg)
    seen = explain_discs(image, site.main_target)
    why = None if seen is None else _sentence(seen, site)
    if why is None:
        return _light_error(image, "main")
    return NotRecognisedError(f"main target: {why}")


def _light_error(image: GreyImage, role: str) -> BadLightError | None:
    fault = light_fault(image, f"[exposure] {role}_us")
    return None if fault is None else BadLightError(f"{role} target: {fault}")


def _sentence(seen: SeenDiscs, site: Site) -> str | None:
    match seen.mismatch:
        case DiscMismatch.MIRRORED:
            return (
                "its discs fit only with left and right exchanged, so the image is mirrored: "
                f"{_REVERSE}; or x in target.main.centres_mm has the wrong sign"
            )
        case DiscMismatch.FLIPPED:
            return (
                "its discs fit only with top and bottom exchanged, so the image is flipped: "
                f"{_REVERSE}; or y in target.main.centres_mm has the wrong sign (y is up)"
            )
        case DiscMismatch.UPSIDE_DOWN:
            return (
                "it is seen upside down; turn the plate or the camera by 180 degrees, or "
                f"{_REVERSE}"
            )
        case DiscMismatch.ON_ITS_SIDE:
            return (
                "it is seen on its side; turn the plate or the camera by 90 degrees, or exchange "
                "x and y in target.main.centres_mm"
            )
        case DiscMismatch.DIAMETER:
            return _diameter(seen, site)
        case DiscMismatch.SCALE:
            return _scale(seen, site)
        case DiscMismatch.LAYOUT:
            return _layout(seen, site)


def _diameter(seen: SeenDiscs, site: Site) -> str:
    """Discs and spacing do not go together; the scale tells which of the two is likely wrong."""
    ratio = seen.diameter_ratio
    seen_mm = ", ".join(digits(mm) for mm in dict.fromkeys(ratio * site.main_target.diameters_mm))
    text = (
        f"its discs are {digits(ratio)} times as wide, for their distances from one another, as "
        "target.main.diameter_mm says"
    )
    scale = seen.px_per_mm / site.nominal_px_per_mm
    if abs(math.log(scale * ratio)) < abs(math.log(scale)):
        return (
            f"{text}, and seen {digits(scale)} times as large; measure the plate: likely "
            f"target.main.centres_mm should all be {digits(1.0 / ratio)} times as large"
        )
    return f"{text}; measure them: about {seen_mm} mm if target.main.centres_mm is right"


def _scale(seen: SeenDiscs, site: Site) -> str | None:
    expected = site.nominal_px_per_mm
    ratio = seen.px_per_mm / expected
    if 1.0 / _FOCAL_FACTOR < ratio < _FOCAL_FACTOR:
        return None  # not the size: what the finder says stands
    swapped = site.sub.focal_length_mm / site.main.focal_length_mm
    if swapped / _FOCAL_FACTOR < ratio < swapped * _FOCAL_FACTOR:
        text = f"its discs are seen, {digits(ratio)} times as large as the config says"
        return f"{text}; exchange camera.main.focal_length_mm and camera.sub.focal_length_mm"
    return _other_scale(seen, site)


def _other_scale(seen: SeenDiscs, site: Site) -> str:
    expected = site.nominal_px_per_mm
    ratio = digits(seen.px_per_mm / expected)
    return (
        f"its discs are seen, {ratio} times as large as the config says "
        f"({digits(seen.px_per_mm)} px/mm instead of {digits(expected)}); correct "
        "camera.main.focal_length_mm, target.main.distance_mm, or, if the plate is another one, "
        "target.main.centres_mm and diameter_mm (all in mm)"
    )


def _layout(seen: SeenDiscs, site: Site) -> str | None:
    count = len(site.main_target.centres_mm)
    if seen.count == count:
        return (
            f"{count} discs are seen, but not at the places of target.main.centres_mm (mm, x right,"
            " y up as the main camera sees it); correct these, or mount the plate of the config"
        )
    if abs(seen.count - count) > count // 2:
        return None  # lamps or drops rather than a plate
    return (
        f"{seen.count} discs are seen, target.main.centres_mm has {count}; clear the view, or "
        "write down the plate that is mounted"
    )
