"""Exposure that follows the light on the targets, from slot to slot and never within one."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import structlog

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board
from core.errors import CoreError
from core.exposure.exposure_rule import Exposure, ExposureRule, next_exposure, within
from core.exposure.target_light import (
    Box,
    TargetLight,
    area_light,
    board_light,
    box_about,
    corners_in_image,
    disc_light,
    discs_in_image,
)
from core.images import GreyImage
from core.recognition import find_targets
from core.results import Measurement
from core.rig.calibrated_site import CalibratedSite
from core.site import MAIN, Site
from daemon.store.database import Store
from daemon.store.records import CameraState
from drivers.protocols import CapturedFrame, CapturedPair, Clock, FramePairSource, Role

if TYPE_CHECKING:
    from daemon.config.reading import Config

_log = structlog.get_logger("dcam.daemon")

_HELD_BACK, _ROUNDED_US = 1.1, 1000.0
"""A camera that exposes so much less than asked is at its own limit; or it rounds, to lines."""
MOST_LOOKS = 12
"""From one end of the ordinary limits to the other takes seven."""
LOOK_PERIOD_S = 1.0
"""Between two looks at targets that are not of a slot of the schedule."""


@dataclass(slots=True)
class _Camera:
    """What is known of one camera's light."""

    rule: ExposureRule
    """Narrowed where the camera's own limits are narrower."""
    asked: Exposure | None = None
    lost_slots: int = 0
    area: Box | None = None
    """Where the target was when it was last found; None: it may be anywhere."""


class ExposureLoop:
    """Follows the light on both targets; between slots, so that a burst is taken alike."""

    def __init__(self, site: Site, rules: Mapping[Role, ExposureRule]) -> None:
        self._site = site
        self._cameras = {role: _Camera(rule) for role, rule in rules.items()}

    def begin(self, source: FramePairSource, known: Mapping[Role, Exposure]) -> None:
        """Expose as is known to have been right, so that a restart finds its targets at once."""
        for role, exposure in known.items():
            self._ask(source, role, within(self._cameras[role].rule, exposure))

    @property
    def asked(self) -> dict[Role, Exposure]:
        """How each camera exposes whose exposure was set here."""
        return {role: camera.asked for role, camera in self._cameras.items() if camera.asked}

    def follow(
        self,
        source: FramePairSource,
        pairs: Sequence[CapturedPair],
        measurement: Measurement | None = None,
        calibrated: CalibratedSite | None = None,
        roles: Sequence[Role] = ("main", "sub"),
    ) -> bool:
        """Look at the pairs of a slot and set the exposure of the next one; tell if it changes.

        measurement and setup say where the targets are; without them they are looked for.
        """
        changed = False
        for role in roles:
            frames = [pair.main if role == "main" else pair.sub for pair in pairs]
            now = _exposure_of(frames[-1])
            if now is None:  # a camera that does not tell cannot be led
                continue
            camera = self._cameras[role]
            images = [GreyImage(frame.pixels, frame.bits) for frame in frames]
            light = self._light(role, camera, images, measurement, calibrated)
            camera.rule = _narrowed(camera, now)
            after = next_exposure(now, camera.rule, light, camera.lost_slots)
            if after not in (now, camera.asked):
                _log.info(
                    "exposure_changed",
                    role=role,
                    white=round(light.white, 3),
                    lost_slots=camera.lost_slots,
                    before_us=now.time_us,
                    before_db=now.gain_db,
                    exposure_us=after.time_us,
                    gain_db=after.gain_db,
                )
                self._ask(source, role, after)
                changed = True
        return changed

    def _ask(self, source: FramePairSource, role: Role, exposure: Exposure) -> None:
        self._cameras[role].asked = exposure
        source.set_exposure(role, exposure.time_us, exposure.gain_db)

    def _light(
        self,
        role: Role,
        camera: _Camera,
        images: Sequence[GreyImage],
        measurement: Measurement | None,
        calibrated: CalibratedSite | None,
    ) -> TargetLight:
        """Light of the target, or of the area where it should be; the median of a burst's."""
        see = self._see_main if role == "main" else self._see_sub
        lights: list[TargetLight] = []
        for image in images if calibrated is not None else images[-1:]:
            light, points_px, margin_px = see(image, measurement, calibrated)
            if light is None or points_px is None:
                break
            camera.area = box_about(image, points_px, margin_px)
            lights.append(light)
        if lights:
            camera.lost_slots = 0
            return _middle(lights)
        camera.lost_slots += 1
        areas = []
        for image in images:
            height, width = image.pixels.shape
            areas.append(area_light(image, camera.area or (0, 0, width, height)))
        return _middle(areas)

    def _see_main(
        self, image: GreyImage, measurement: Measurement | None, calibrated: CalibratedSite | None
    ) -> _Seen:
        """The brightest of all targets, so that none is overexposed; the main one must be seen."""
        if calibrated is None:
            places = self._find_plates(image)
        elif measurement is None or measurement.raw is None:
            return _UNSEEN
        else:
            places = self._measured_plates(measurement, calibrated)
        seen = []
        for points, radii in places:
            light = disc_light(image, points, radii)
            if light is not None:
                seen.append((light, points, 2.0 * float(radii.max())))
        return max(seen, key=lambda one: one[0].white, default=_UNSEEN)

    def _measured_plates(
        self, measurement: Measurement, calibrated: CalibratedSite
    ) -> list[_Places]:
        """Where the measurement says that the targets' discs are."""
        raw = {MAIN: measurement.raw, **{one.name: one.raw for one in measurement.targets}}
        drawn = {MAIN: self._site.main_target}
        drawn |= {extra.name: extra.target for extra in self._site.extra_targets}
        places = []
        for target in (calibrated.main_target, *calibrated.further):
            found = raw.get(target.name)
            if found is not None and target.name in drawn:
                places.append(discs_in_image(target, drawn[target.name], found))
        return places

    def _find_plates(self, image: GreyImage) -> list[_Places]:
        """Where the image shows them; none without the main one."""
        site = self._site
        try:
            found = find_targets(image, site)
        except CoreError:
            return []
        if found[0] is None:
            return []
        places = []
        for discs, target in zip(found, site.targets, strict=True):
            if discs is not None:
                px_per_mm = site.main.focal_px / target.distance_mm
                radii = px_per_mm * target.diameters_mm[discs.found] / 2.0
                places.append((discs.points_px[discs.found], radii))
        return places

    def _see_sub(
        self, image: GreyImage, measurement: Measurement | None, calibrated: CalibratedSite | None
    ) -> _Seen:
        if calibrated is not None:
            if measurement is None or measurement.motion is None:
                return _UNSEEN
            board = calibrated.board
            index, points = corners_in_image(calibrated, measurement.motion)
        else:
            board = Board.nominal(self._site.sub_target)
            try:
                view = detect_board(image, board).view
            except CoreError:
                return _UNSEEN
            index, points = view.index, view.points_px
        return board_light(image, board, index, points), points, 0.0


_Places = tuple[FloatArray, FloatArray]
"""A target's discs in an image (n, 2) and their radii (n,), px."""
_Seen = tuple[TargetLight | None, FloatArray | None, float]
"""A target's light, where it was seen (n, 2) px, and the margin about that in px."""
_UNSEEN: _Seen = (None, None, 0.0)


def loop_of(config: Config) -> ExposureLoop | None:
    """Give the loop that a config asks for; None where exposure is fixed."""
    section = config.exposure
    if section.mode == "fixed":
        return None
    rules: dict[Role, ExposureRule] = {
        "main": _rule(
            section.main_us, section.main_gain_db, section.main_limits_us,
            section.main_gain_limits_db, section.white_level,
        ),
        "sub": _rule(
            section.sub_us, section.sub_gain_db, section.sub_limits_us,
            section.sub_gain_limits_db, section.white_level,
        ),
    }  # fmt: skip
    return ExposureLoop(config.site(), rules)


def _rule(
    start_us: float,
    start_db: float | None,
    limits_us: tuple[float, float],
    limits_db: tuple[float, float],
    white: float,
) -> ExposureRule:
    start = Exposure(start_us, limits_db[0] if start_db is None else start_db)
    return ExposureRule(start, *limits_us, *limits_db, white)


def last_known(store: Store) -> dict[Role, Exposure]:
    """How the cameras exposed in the last row, as far as it tells. Raises StoreError."""
    last = store.last_slot()
    record = store.measurement(last) if last is not None else None
    if record is None:
        return {}
    states: dict[Role, CameraState] = {"main": record.main_camera, "sub": record.sub_camera}
    return {
        role: Exposure(state.exposure_us, state.gain_db)
        for role, state in states.items()
        if state.exposure_us
    }


def settle(source: FramePairSource, clock: Clock, loop: ExposureLoop) -> None:
    """Look at the targets until their light is right, a second apart; then it is left alone.

    Raises DeviceError.
    """
    for _ in range(MOST_LOOKS):
        slot_utc = next_second(clock)
        if not loop.follow(source, [source.capture(slot_utc)]):
            return


def next_second(clock: Clock) -> datetime:
    """Wait for the next look; give its whole second, a new one every time."""
    ready = clock.now_utc() + timedelta(seconds=LOOK_PERIOD_S)
    slot_utc = ready.replace(microsecond=0) + timedelta(seconds=1 if ready.microsecond else 0)
    clock.wait_until(slot_utc, threading.Event())
    return slot_utc


def _exposure_of(frame: CapturedFrame) -> Exposure | None:
    if not frame.exposure_us:
        return None
    return Exposure(frame.exposure_us, frame.gain_db)


def _narrowed(camera: _Camera, now: Exposure) -> ExposureRule:
    """Take the camera's own longest exposure for the rule's, if it showed: gain goes on there."""
    rule, asked = camera.rule, camera.asked
    if asked is None or asked.time_us < _HELD_BACK * now.time_us or now.time_us < _ROUNDED_US:
        return rule
    return replace(rule, most_us=now.time_us, least_us=min(rule.least_us, now.time_us))


def _middle(lights: Sequence[TargetLight]) -> TargetLight:
    return sorted(lights, key=lambda light: light.white)[len(lights) // 2]
