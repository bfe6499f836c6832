"""The plates of discs before the main camera: the main target and the site's further ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.site import CirclesTarget, ExtraTarget, Site, TargetRole
from drivers.sim.breathing import random_walk
from drivers.sim.geometry import FLIP_Y_Z, Draw
from drivers.sim.settings import SimPlate, SimSettings

PLATE_MARGIN = 1.75
"""Black plate beyond the outermost disc centres, in disc diameters."""

PLACES = (97, 61)
"""Places that are tried for a plate of which nobody says where it stands, across and down."""

DAY_MIN = 1440.0


@dataclass(frozen=True, slots=True)
class TruePlate:
    """One plate as it was put up, and how it moves."""

    name: str
    T_CM_W: Pose
    """The plate against the main camera, everything at rest; its frame is as WM."""
    discs_mm: FloatArray
    """(n, 3) x, y, radius."""
    outline_mm: FloatArray
    """(4,) x0, y0, x1, y1 of the black plate."""
    bridge_factor: float
    moves: SimPlate
    walk_seed: tuple[int, ...]

    @property
    def distance_mm(self) -> float:
        """How far it is from the main camera."""
        return float(self.T_CM_W.t_mm[2])

    def displacement_mm(self, minute: float, bridge_mm: FloatArray) -> FloatArray:
        """(3,) from where it was put up: its share of the bridge's, and its own."""
        moved_mm = self.bridge_factor * bridge_mm
        if minute > 0.0 and self.moves.creep_mm_per_sqrt_day > 0.0:
            walk = random_walk(self.walk_seed, minute / DAY_MIN, 2)
            moved_mm = moved_mm + np.append(self.moves.creep_mm_per_sqrt_day * walk, 0.0)
        if minute >= self.moves.knock_min:
            moved_mm = moved_mm + np.append(self.moves.knock_mm, 0.0)
        return moved_mm

    def is_hidden(self, minute: float) -> bool:
        """Whether something stands before it."""
        return any(first <= minute < end for first, end in self.moves.hidden_min)


def main_plate(site: Site, T_CM_WM: Pose) -> TruePlate:
    """Give the main target: it moves as the bridge does."""
    discs_mm, outline_mm = _drawn(site.main_target)
    return TruePlate("main", T_CM_WM, discs_mm, outline_mm, 1.0, SimPlate("main"), ())


def further_plates(site: Site, settings: SimSettings, T_CM_WM: Pose) -> tuple[TruePlate, ...]:
    """Put up the site's further plates, in its order, each tilted and away as it may be.

    Raises ValueError for settings of a plate that the site has not, and for no place.
    """
    names = [extra.name for extra in site.extra_targets]
    moves = {plate.name: plate for plate in settings.plates}
    for name in moves.keys() - set(names):
        msg = f"simulation.plates: there is no plate {name!r}; the site has: {', '.join(names)}"
        raise ValueError(msg)
    known = [moves.get(name, SimPlate(name)) for name in names]
    places_mm = _places_mm(site, known)
    plates = []
    for number, (extra, plate) in enumerate(zip(site.extra_targets, known, strict=True)):
        rng = np.random.default_rng([settings.seed, 12, number])
        draw = Draw(rng, settings.as_built.scale)
        turn = draw(np.radians(np.full(3, settings.as_built.target_tilt_deg)))
        departure_mm = draw(np.array([extra.target.distance_sigma_mm]))[0]
        at_mm = T_CM_WM.apply(np.append(places_mm[number], 0.0)[None])[0]
        at_mm[2] = extra.target.distance_mm + departure_mm
        usual = 1.0 if extra.role is TargetRole.MEASURED else 0.0
        plates.append(
            TruePlate(
                extra.name,
                Pose(Rotation.from_rotvec(turn).as_matrix() @ FLIP_Y_Z, at_mm),
                *_drawn(extra.target),
                usual if plate.bridge_factor is None else plate.bridge_factor,
                plate,
                (settings.seed, 13, number),
            )
        )
    return tuple(plates)


def _drawn(target: CirclesTarget) -> tuple[FloatArray, FloatArray]:
    """Discs (n, 3) x, y, radius and the outline (4,) of their plate, mm."""
    margin = PLATE_MARGIN * float(target.diameters_mm.max())
    low, high = target.centres_mm.min(axis=0), target.centres_mm.max(axis=0)
    discs_mm = np.column_stack([target.centres_mm, target.diameters_mm / 2.0])
    return discs_mm, np.concatenate([low - margin, high + margin])


# ------------------------------------------------------------------ where plates stand


def _places_mm(site: Site, plates: Sequence[SimPlate]) -> list[FloatArray]:
    """Offset (2,) of each plate's middle from the main target's, in WM.

    First those of which somebody says where they stand, then the others, each in most room.
    """
    taken = {"main": _box_px(site, site.main_target, np.zeros(2))}
    found: dict[str, FloatArray] = {}
    pairs = list(zip(site.extra_targets, plates, strict=True))
    for extra, plate in sorted(pairs, key=lambda pair: _stated_mm(site, *pair) is None):
        stated_mm = _stated_mm(site, extra, plate)
        place_mm = _roomiest_mm(site, extra, taken) if stated_mm is None else stated_mm
        box = _box_px(site, extra.target, place_mm)
        size_px = np.array([site.main.width_px, site.main.height_px])
        if np.any(box[2:] < 0.0) or np.any(box[:2] > size_px):
            msg = (
                f"simulation.plates: {extra.name!r} would stand outside the main image; bring "
                "its offset_mm nearer to 0"
            )
            raise ValueError(msg)
        for other, its_box in taken.items():
            if _gaps_px(box, its_box) <= 0.0:
                msg = (
                    f"simulation.plates: {extra.name!r} would stand over {other!r} in the main "
                    "image; give its offset_mm, or a smaller plate"
                )
                raise ValueError(msg)
        taken[extra.name] = box
        found[extra.name] = place_mm
    return [found[extra.name] for extra in site.extra_targets]


def _stated_mm(site: Site, extra: ExtraTarget, plate: SimPlate) -> FloatArray | None:
    if plate.offset_mm is not None:
        return np.array(plate.offset_mm)
    if extra.position_px is not None:
        return _at_mm(site, extra.target, extra.position_px)
    return None


def _at_mm(site: Site, target: CirclesTarget, at_px: FloatArray) -> FloatArray:
    """Where in WM (..., 2) a plate stands whose middle is seen there, by the drawing."""
    per_px = target.distance_mm / site.main.focal_px
    return np.asarray((at_px - site.main.centre_px) * [per_px, -per_px])


def _box_px(site: Site, target: CirclesTarget, place_mm: FloatArray) -> FloatArray:
    """Where plates are seen at these offsets (..., 2), by the drawing: (..., 4) u0, v0, u1, v1."""
    px_per_mm = site.main.focal_px / target.distance_mm
    x0, y0, x1, y1 = _drawn(target)[1]
    flipped = np.array([px_per_mm, -px_per_mm])
    top_left = (place_mm + np.array([x0, y1])) * flipped
    bottom_right = (place_mm + np.array([x1, y0])) * flipped
    centre = site.main.centre_px
    return np.concatenate([centre + top_left, centre + bottom_right], axis=-1)


def _gaps_px(boxes: FloatArray, other: FloatArray) -> FloatArray:
    """How far boxes (..., 4) are from another (4,); not above 0 where they overlap."""
    apart = np.maximum(boxes[..., :2] - other[2:], other[:2] - boxes[..., 2:])
    return np.asarray(apart.max(axis=-1))


def _roomiest_mm(site: Site, extra: ExtraTarget, taken: dict[str, FloatArray]) -> FloatArray:
    """Offset (2,) with most room to the image's edges and the other plates.

    Raises ValueError where the plate fits nowhere.
    """
    size_px = np.array([site.main.width_px, site.main.height_px]) - 1.0
    u, v = np.meshgrid(*(np.linspace(0.0, size_px[k], PLACES[k]) for k in range(2)))
    places_mm = _at_mm(site, extra.target, np.stack([u.ravel(), v.ravel()], axis=1))
    boxes = _box_px(site, extra.target, places_mm)
    room_px = np.minimum(boxes[:, :2], size_px - boxes[:, 2:]).min(axis=1)
    for box in taken.values():
        room_px = np.minimum(room_px, _gaps_px(boxes, box))
    best = int(room_px.argmax())
    if room_px[best] <= 0.0:
        msg = (
            f"simulation.plates: no room for {extra.name!r} beside the other plates in the main "
            "image; give its offset_mm, or a smaller plate"
        )
        raise ValueError(msg)
    return np.asarray(places_mm[best])
