"""What is true at an instant of the simulated world, relative to a reference instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from core.arrays import FloatArray
from core.geometry.pose import Pose
from drivers.sim.settings import ScenarioKind


@dataclass(frozen=True, slots=True)
class Temperatures:
    """What is how warm."""

    main_c: float
    """The main camera."""
    sub_c: float
    air_c: float
    """The air, and the board on the pier."""


@dataclass(frozen=True, slots=True)
class PlateTruth:
    """What is true of one further plate."""

    displacement_mm: FloatArray
    """(2,) in its own frame, x right and y up as in WM."""
    shift_px: FloatArray
    """(2,) of its middle, as `Truth.shift_px`."""
    hidden: bool


@dataclass(frozen=True, slots=True)
class Truth:
    """What is true at an instant, relative to a reference instant."""

    displacement_mm: FloatArray
    """(2,) of the main target in WM: x right, y up."""
    false_mm: FloatArray
    """(2,) false displacement: what the rig's motion alone makes of the target's centre."""
    motion: Pose
    """Rig motion `T_CSj_CS1`."""
    cases: tuple[ScenarioKind, ...]
    """What disturbs the images: night, an insect ..."""
    shift_px: FloatArray
    """(2,) of the main target's centre in the image by what the two cameras do not share: turns
    and creep between them, the main lens, the air, and what the sub-camera takes for the rig's
    motion although it is the board's on the pier or a shift of its own lens."""
    temperature: Temperatures
    plates: Mapping[str, PlateTruth]
    """Of the site's further plates, in its order."""
