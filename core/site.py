"""What a surveyor knows of a site: cameras, targets and the rig as drawn, with their priors."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from core.arrays import FloatArray
from core.lens_model import LensModel


@dataclass(frozen=True, slots=True)
class CameraGeometry:
    """Nominal geometry of one camera.

    >>> camera = CameraGeometry(1920, 1200, pixel_pitch_um=5.86, focal_length_mm=6.0)
    >>> round(camera.focal_px, 1), camera.centre_px.tolist()
    (1023.9, [959.5, 599.5])
    """

    width_px: int
    height_px: int
    pixel_pitch_um: float
    focal_length_mm: float

    @property
    def focal_px(self) -> float:
        """Nominal focal length in pixels, f / pitch."""
        return self.focal_length_mm * 1000.0 / self.pixel_pitch_um

    @property
    def centre_px(self) -> FloatArray:
        """(2,) the middle of the image."""
        return np.array([0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1)])


@dataclass(frozen=True, slots=True)
class CirclesTarget:
    """White discs on black; centres in WM (x right, y up as the main camera sees it)."""

    centres_mm: FloatArray
    """(n, 2) disc centres, mm."""
    diameters_mm: FloatArray
    """(n,) disc diameters, mm."""
    distance_mm: float
    distance_sigma_mm: float


MAIN = "main"
"""The name of the main target among others."""


class TargetRole(StrEnum):
    """What a further target in the main image is for."""

    FIXED = "fixed"
    """It does not move with the bridge, so that it shows the rig's own error."""
    MEASURED = "measured"
    """A further point of the bridge."""


@dataclass(frozen=True, slots=True)
class ExtraTarget:
    """A further target in the main camera's image."""

    name: str
    role: TargetRole
    target: CirclesTarget
    position_px: FloatArray | None = None
    """(2,) about where its middle is in the reference image; None where size and layout tell."""
    stable_mm: float = 0.0
    """1 sigma of a fixed target's own movement, in x and in y; with 0 displacements are beside it,
    as levels are beside a benchmark."""


@dataclass(frozen=True, slots=True)
class CheckerboardTarget:
    """A checkerboard; the square at the WS origin (top left in the sub image) is black."""

    squares_x: int
    squares_y: int
    square_mm: float
    distance_mm: float
    distance_sigma: float = 0.02
    """Relative, 1 sigma: 1 mm at 50 mm as drawn, from the optical centre."""
    scale_sigma: float = 1e-3
    """Relative, 1 sigma, of the print's scale: a board of 64 mm measured to 0.06 mm."""


@dataclass(frozen=True, slots=True)
class RigPrior:
    """`T_CM_CS` as drawn: X_CM = R X_CS + t, with 1-sigma tolerances."""

    rotation_main_sub_deg: FloatArray
    """(3,) xyz Euler angles, extrinsic, degrees."""
    rotation_sigma_deg: float
    offset_main_sub_mm: FloatArray
    """(3,) t_CM_CS, mm."""
    offset_sigma_mm: float


@dataclass(frozen=True, slots=True)
class QualityLimits:
    """What a row must hold to be called good, and the drift that a calibration must carry."""

    expected_drift_mrad: float = 1.0
    expected_drift_mm: float = 1.5
    max_sigma_mm: float = 0.5
    """A corrected displacement with a larger sigma is suspect."""
    max_skew_ms: float = 20.0
    """A pair taken further apart is suspect."""
    max_step_mm: float | None = None
    """A target that moves further from one slot to the next is suspect; None: no limit."""


@dataclass(frozen=True, slots=True)
class StabilityBudget:
    """What may have changed since the calibration and the images cannot show; 1 sigma of each.

    The defaults are for two cameras bolted to a steel plate, a machine-vision lens and a line of
    sight in the open; docs/method.md says which have a source.
    """

    cameras_urad_per_k: float = 1.5
    """Of one camera against the other, about each axis."""
    cameras_urad_per_sqrt_day: float = 1.2
    board_urad_per_k: float = 0.5
    """Of the board on the pier, about each axis."""
    board_urad_per_sqrt_day: float = 0.4
    board_expansion_per_k: float = 7e-5
    """Of a board of PVC foam."""
    main_px_per_k: float = 0.02
    """Shift of the main camera's image, in x and in y."""
    main_scale_per_k: float = 7e-5
    """Relative, of the main camera's scale."""
    sub_px_per_k: float = 0.005
    """Shift of the sub-camera's image, in x and in y."""
    air_gradient_k_per_m: float = 0.1
    """Of the air's temperature across the line of sight, less what it was at the calibration."""
    temperature_range_k: float = 10.0
    """Of the site's temperature about its mean, where nothing tells it."""


@dataclass(frozen=True, slots=True)
class Site:
    """One dual-camera site."""

    main: CameraGeometry
    sub: CameraGeometry
    main_target: CirclesTarget
    sub_target: CheckerboardTarget
    rig: RigPrior
    quality: QualityLimits
    lens_model: LensModel | None = None
    """Of the sub-camera; None: the one that predicts held-out views best."""
    extra_targets: tuple[ExtraTarget, ...] = ()
    """In the order of the config."""
    stability: StabilityBudget = field(default_factory=StabilityBudget)
    temperature_reading: str | None = None
    """Name of the sensor that tells how warm steel and board are; None: the cameras do."""

    @property
    def nominal_px_per_mm(self) -> float:
        """The main camera's scale at its target by the lens's nominal focal length."""
        return self.main.focal_px / self.main_target.distance_mm

    @property
    def has_fixed_target(self) -> bool:
        """Whether a target in the main image shows the rig's own error."""
        return any(extra.role is TargetRole.FIXED for extra in self.extra_targets)

    @property
    def targets(self) -> tuple[CirclesTarget, ...]:
        """All that the main image shows: the main target first, then the further ones."""
        return (self.main_target, *(extra.target for extra in self.extra_targets))
