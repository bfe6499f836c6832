"""One simulated world: a true rig that truly moves, seen by two cameras. It knows the truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.site import Site
from drivers.protocols import Image, Role
from drivers.sim.breathing import Breath, TrueBreathing, pose_by_shift
from drivers.sim.climate import TrueClimate
from drivers.sim.effects import (
    draw_cobweb,
    draw_cover,
    draw_glare,
    draw_insect,
    draw_rain,
    draw_snow,
    haze_mm,
)
from drivers.sim.geometry import (
    TrueGeometry,
    bonded_again,
    build_geometry,
    held_board_pose,
    refocused,
)
from drivers.sim.kernels import Float32Array
from drivers.sim.light import TrueLight
from drivers.sim.motion import TrueMotion
from drivers.sim.plates import TruePlate, further_plates, main_plate
from drivers.sim.render import ORDINARY, CameraRenderer, Exposed, Look
from drivers.sim.settings import DISTURBANCES, ScenarioKind, SimSettings
from drivers.sim.truth import PlateTruth, Temperatures, Truth


@dataclass(frozen=True, slots=True)
class _State:
    """Where rig and bridge are, and how they have changed."""

    T_CSj_CS0: Pose
    """CS0 is the sub-camera at rest."""
    bridge_mm: FloatArray
    """(3,) in WM."""
    breath: Breath
    minute: float
    """Since the start."""


class World:
    """A rig built from a site's drawing, with its head, drift, bridge, weather and cameras."""

    def __init__(self, site: Site, settings: SimSettings, *, renders: bool = True) -> None:
        """Build it. renders=False: only the truth is asked for, which spares the cameras' rays."""
        self.site = site
        self.settings = settings
        self.geometry: TrueGeometry = build_geometry(site, settings)
        self._motion = TrueMotion(settings)
        self._light = TrueLight(settings)
        self._climate = TrueClimate(settings)
        self._breathing = TrueBreathing(settings, self._climate, self.geometry.board)
        self._still_utc: datetime | None = None
        self._head_deg: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)
        self._held: tuple[int, Pose] | None = None
        self._slip = Pose.identity()
        self._board = self.geometry.board
        T_CM_WM = self.geometry.T_CM_WM
        self._target = main_plate(site, T_CM_WM)
        self._further = further_plates(site, settings, T_CM_WM)
        self._renderers = self._make_renderers() if renders else {}
        for role in self._renderers:  # compiles the kernels here, not within a camera's deadline
            self.render(role, settings.start_utc)

    def _make_renderers(self) -> dict[Role, CameraRenderer]:
        site, optics, sensor = self.site, self.settings.optics, self.settings.sensor
        uphill = np.random.default_rng([self.settings.seed, 3]).uniform(0, 6.28)
        main = Look(optics.main_blur_px, optics.corner_blur, optics.main_shading, uphill)
        sub = Look(optics.sub_blur_px, optics.corner_blur, optics.sub_shading, uphill + 2.0)
        return {
            "main": CameraRenderer(site.main, self.geometry.main, main, sensor),
            "sub": CameraRenderer(site.sub, self.geometry.sub, sub, sensor),
        }

    # ------------------------------------------------------------------ what moves the rig

    def turn_head(self, pan_deg: float, tilt_deg: float) -> None:
        """Put the pan-tilt head at these true angles."""
        self._head_deg = lambda: (pan_deg, tilt_deg)

    def follow_head(self, angles_deg: Callable[[], tuple[float, float]]) -> None:
        """Let the rig stand on a head that says where it is whenever it is asked."""
        self._head_deg = angles_deg

    def head_deg(self) -> tuple[float, float]:
        """Give the true angles of the pan-tilt head, now. Raises DeviceError for one elsewhere."""
        return self._head_deg()

    def hold_board(self, number: int | None) -> None:
        """Hold the board by hand before the sub-camera, in pose `number`; None: bonded again."""
        if number is None:
            self._held = None
            return
        rng = np.random.default_rng([self.settings.seed, 4, number])
        self._held = (number, held_board_pose(self.site, self.geometry, rng))

    def slip_board(self, x_mm: float, y_mm: float, turn_deg: float = 0.0) -> None:
        """Let the board sit elsewhere on the pier than when it was bonded, turned about its middle.

        The truth stays: neither the rig nor the bridge has moved. 0, 0 puts it back.
        """
        middle = np.append(self.geometry.board.size_mm / 2.0, 0.0)
        turn = np.array([0.0, 0.0, math.radians(turn_deg)])
        slip = Pose.from_vectors(turn, np.zeros(3))
        shift = np.array([x_mm, y_mm, 0.0])
        self._slip = Pose(slip.R, middle - slip.R @ middle + shift)

    def replace_board(self, seed: int | None) -> None:
        """Put another print of the same drawing in the board's place; None: the first one."""
        other = replace(self.settings, seed=self.settings.seed if seed is None else seed)
        self._board = build_geometry(self.site, other).board

    def bond_board(self, number: int) -> None:
        """Take the board off the pier and bond it again: another pose for each number."""
        T_CS_WS = bonded_again(self.site, self.settings, number)
        self.geometry = replace(self.geometry, T_CS_WS=T_CS_WS)

    def refocus(self, role: Role, number: int) -> None:
        """Turn a lens's focus ring: another focal length and principal point for each number."""
        rng = np.random.default_rng([self.settings.seed, 15, role == "sub", number])
        if role == "main":
            lens = refocused(self.geometry.main, self.site.main, rng)
            self.geometry = replace(self.geometry, main=lens)
        else:
            lens = refocused(self.geometry.sub, self.site.sub, rng)
            self.geometry = replace(self.geometry, sub=lens)

    def hold_still(self, at_utc: datetime | None) -> None:
        """Stop drift, bridge and breathing as they are at an instant, for a calibration.

        Light, weather and noise go on. None: let go.
        """
        self._still_utc = at_utc

    # ------------------------------------------------------------------ what is true

    def truth(self, t_utc: datetime, reference_utc: datetime | None = None) -> Truth:
        """Give the truth, the head where it is now, relative to a reference with the head at rest.

        Without a reference time the reference is the rig at rest, as before `start_utc`.
        """
        now = self._state(t_utc)
        reference = self._at_rest(reference_utc or self.settings.start_utc)
        if reference_utc is None:
            reference = replace(reference, T_CSj_CS0=Pose.identity(), bridge_mm=np.zeros(3))
        target = self._target
        origin_px = self._middle_px(target, reference)
        moved = replace(reference, T_CSj_CS0=now.T_CSj_CS0)
        moved_px = self._middle_px(target, moved)
        false_mm = np.linalg.solve(self._px_per_mm(reference), moved_px - origin_px)
        seen = self._seen_motion(now).compose(self._seen_motion(reference).inverse())
        expected = replace(
            now, T_CSj_CS0=seen.compose(reference.T_CSj_CS0), breath=reference.breath
        )

        def shift_px(plate: TruePlate) -> FloatArray:
            return self._middle_px(plate, now) - self._middle_px(plate, expected)

        return Truth(
            displacement_mm=(now.bridge_mm - reference.bridge_mm)[:2],
            false_mm=false_mm,
            motion=now.T_CSj_CS0.compose(reference.T_CSj_CS0.inverse()),
            cases=tuple(kind for kind in DISTURBANCES if self.active(kind, t_utc)),
            shift_px=shift_px(target),
            temperature=self.temperatures(t_utc),
            plates={
                plate.name: PlateTruth(
                    (_displacement_mm(plate, now) - _displacement_mm(plate, reference))[:2],
                    shift_px(plate),
                    plate.is_hidden(self._minute(t_utc)),
                )
                for plate in self._further
            },
        )

    def temperatures(self, t_utc: datetime) -> Temperatures:
        """Give the true temperatures; before the start they are those of the start."""
        moment, climate = self._moment(t_utc), self._climate
        main_c, sub_c = climate.camera_c("main", moment), climate.camera_c("sub", moment)
        return Temperatures(main_c, sub_c, climate.air_c(moment))

    def reported_c(self, role: Role, t_utc: datetime) -> float:
        """Give the temperature that a camera reports with the frame of this instant."""
        true_c = self._climate.camera_c(role, self._moment(t_utc))
        return self._climate.reported_c(role, true_c, t_utc)

    def active(self, kind: ScenarioKind, t_utc: datetime, role: Role | None = None) -> bool:
        """Tell whether a scenario is on, for this camera if one is named."""
        minute = self._minute(t_utc)
        return any(
            scenario.strikes(role) and scenario.minutes_inside(minute) is not None
            for scenario in self.settings.scenarios
            if scenario.kind == kind
        )

    def disc_centres_px(self, t_utc: datetime, plate: str | None = None) -> FloatArray:
        """True images (n, 2) of a plate's disc centres in the main camera; None: the target's."""
        of = self._target
        if plate is not None:
            of = next(further for further in self._further if further.name == plate)
        centres = np.column_stack([of.discs_mm[:, :2], np.zeros(len(of.discs_mm))])
        return self._project_main(of, self._state(t_utc), centres)

    def board_corners_px(self, t_utc: datetime) -> FloatArray:
        """True images (squares_y + 1, squares_x + 1, 2) of all line crossings in the sub-camera."""
        state = self._state(t_utc)
        corners = state.breath.board(self._board).corners_mm()
        seen = self._board_pose(state).apply(corners.reshape(-1, 3))
        return state.breath.sub_lens(self.geometry.sub).project(seen).reshape(*corners.shape[:2], 2)

    # ------------------------------------------------------------------ what the cameras see

    def render(
        self,
        role: Role,
        t_utc: datetime,
        head_deg: tuple[float, float] | None = None,
        exposed: Exposed = ORDINARY,
    ) -> Image:
        """Render one camera's image; the same instant gives the same image, noise and all.

        `head_deg` is where the head was at that instant, if it has moved since.
        """
        number = self._held[0] + 1 if self._held else 0
        moment_us = round(t_utc.timestamp() * 1e6)
        rng = np.random.default_rng([self.settings.seed, 5, role == "sub", number, moment_us])
        optics, state = self.settings.optics, self._state(t_utc, role, head_deg)
        renderer = self._renderers[role]
        if role == "main":
            renderer.refocus(state.breath.main_lens(self.geometry.main))
            image = self._plates(renderer, state, t_utc, rng)
            if self.active("insect_main", t_utc):
                at_px = self.disc_centres_px(t_utc)[rng.integers(len(self._target.discs_mm))]
                draw_insect(image, at_px + rng.normal(size=2), self._insect_px("main"), rng)
        else:
            renderer.refocus(state.breath.sub_lens(self.geometry.sub))
            pose, board = self._board_pose(state), state.breath.board(self._board)
            image = renderer.board(pose, board, optics.sub_white, optics.sub_black)
            if self.active("insect_sub", t_utc):
                view = np.array([self.site.sub.width_px, self.site.sub.height_px])
                at_px = view * rng.uniform(0.35, 0.65, 2)
                draw_insect(image, at_px, self._insect_px("sub"), rng)
        if self.active("snow", t_utc, role):
            draw_snow(image, rng)
        if self.active("rain", t_utc, role):
            draw_rain(image, rng)
        if self.active("cobweb", t_utc, role):
            draw_cobweb(image, rng)
        if self.active("cover", t_utc, role):
            draw_cover(image, rng)
        lit = renderer.lit(image, self._light.of(role, self._minute(t_utc)))
        if self.active("glare", t_utc, role):
            draw_glare(lit, rng)
        return renderer.expose(lit, optics.pedestal, rng, exposed)

    def _plates(
        self, renderer: CameraRenderer, state: _State, t_utc: datetime, rng: np.random.Generator
    ) -> Float32Array:
        """Reflectance of the main target and the further plates that nothing hides."""
        optics = self.settings.optics
        greys = np.array([optics.main_white, optics.main_black, optics.main_grey])
        minute, target, haze = self._minute(t_utc), self._target, self.active("haze", t_utc)

        def discs_mm(plate: TruePlate) -> FloatArray:
            discs = plate.discs_mm.copy()
            if haze:
                sigma_mm = optics.haze_mm * plate.distance_mm / target.distance_mm
                discs[:, :2] += haze_mm(len(discs), sigma_mm, rng)
            return discs

        pose = self._plate_pose(target, state)
        image = renderer.discs(pose, discs_mm(target), target.outline_mm, greys)
        for plate in self._further:
            if not plate.is_hidden(minute):
                pose = self._plate_pose(plate, state)
                renderer.add_plate(image, pose, discs_mm(plate), plate.outline_mm, greys)
        return image

    # ------------------------------------------------------------------ inside

    def _minute(self, t_utc: datetime) -> float:
        return (t_utc - self.settings.start_utc).total_seconds() / 60.0

    def _moment(self, t_utc: datetime) -> datetime:
        """The instant at which rig and bridge are as now."""
        return max(self._still_utc or t_utc, self.settings.start_utc)

    def _at_rest(self, t_utc: datetime) -> _State:
        """Where everything is with the head at rest."""
        minute = self._minute(t_utc)
        breath = self._breathing.at(max(t_utc, self.settings.start_utc))
        return _State(self._motion.drift(minute), self._motion.bridge_mm(minute), breath, minute)

    def _state(
        self, t_utc: datetime, role: Role = "sub", head_deg: tuple[float, float] | None = None
    ) -> _State:
        """Where everything is; the main camera may shake apart from the sub-camera."""
        rest = self._at_rest(self._still_utc or t_utc)
        turned = self.geometry.head_pose(*(head_deg or self.head_deg())).inverse()
        moved = turned.compose(rest.T_CSj_CS0)
        if self.active("vibration", t_utc):
            moved = self._shake(t_utc, role).compose(moved)
        return replace(rest, T_CSj_CS0=moved)

    def _shake(self, t_utc: datetime, role: Role) -> Pose:
        motion = self.settings.motion
        rng = np.random.default_rng([self.settings.seed, 8, round(t_utc.timestamp() * 1e6)])
        together, apart = rng.normal(0.0, motion.vibration_mrad * 1e-3, (2, 3))
        share = motion.vibration_apart if role == "main" else 0.0
        return Pose.from_vectors(together + share * apart, np.zeros(3))

    def _plate_pose(self, plate: TruePlate, state: _State) -> Pose:
        """`T_CMj_W`: through the rig, because the main camera is bolted to the sub-camera."""
        T_CM_CS, breath = self.geometry.T_CM_CS, state.breath
        T_CMj_CM0 = T_CM_CS.compose(state.T_CSj_CS0).compose(T_CM_CS.inverse())
        # Up is the same for all plates, however each is turned.
        R_W_WM = plate.T_CM_W.R.T @ self._target.T_CM_W.R
        seems_mm = _displacement_mm(plate, state) + R_W_WM @ breath.bending_mm(plate.distance_mm)
        moved = Pose(np.eye(3), seems_mm)
        return breath.T_CM_CM0.compose(T_CMj_CM0).compose(plate.T_CM_W).compose(moved)

    def _board_pose(self, state: _State) -> Pose:
        if self._held:
            return self._held[1]
        bonded = state.T_CSj_CS0.compose(self.geometry.T_CS_WS)
        return bonded.compose(state.breath.T_WS0_WS).compose(self._slip)

    def _seen_motion(self, state: _State) -> Pose:
        """The rig's motion from rest as the bonded board shows it through the shifted lens."""
        true = self.geometry
        T_CSj_WS = state.T_CSj_CS0.compose(true.T_CS_WS).compose(state.breath.T_WS0_WS)
        shift_px = state.breath.sub_shift_px
        if shift_px.any():
            apparent = pose_by_shift(true.sub, self.site.sub, true.T_CS_WS, true.board, shift_px)
            T_CSj_WS = T_CSj_WS.perturbed(apparent)
        return T_CSj_WS.compose(true.T_CS_WS.inverse())

    def _project_main(self, plate: TruePlate, state: _State, points_mm: FloatArray) -> FloatArray:
        lens = state.breath.main_lens(self.geometry.main)
        return lens.project(self._plate_pose(plate, state).apply(points_mm))

    def _middle_px(self, plate: TruePlate, state: _State) -> FloatArray:
        """(2,) where a plate's origin is seen."""
        return np.asarray(self._project_main(plate, state, np.zeros((1, 3)))[0])

    def _px_per_mm(self, state: _State) -> FloatArray:
        """`B~` (2, 2) of Eq. 7 at the target's centre, by central differences over 2 mm."""
        steps = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
        px = self._project_main(self._target, state, steps)
        return np.column_stack([px[0] - px[1], px[2] - px[3]]) / 2.0

    def _insect_px(self, role: Role) -> float:
        """Length of an insect: a disc and a half, or five squares of the board."""
        if role == "main":
            size_mm, away_mm = (
                1.5 * self._target.discs_mm[:, 2].max() * 2.0,
                self.site.main_target.distance_mm,
            )
            return float(size_mm * self.site.main.focal_px / away_mm)
        target = self.site.sub_target
        return 5.0 * target.square_mm * self.site.sub.focal_px / target.distance_mm


def _displacement_mm(plate: TruePlate, state: _State) -> FloatArray:
    return plate.displacement_mm(state.minute, state.bridge_mm)
