"""Sites for the tests of the simulation, and settings without weather or noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    QualityLimits,
    RigPrior,
    Site,
)
from drivers.sim.settings import AsBuilt, Optics, Sensor, SimSettings

CENTRES_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])


def site(shrink: int = 4, distance_mm: float = 11000.0, **changes: object) -> Site:
    """The laboratory site, its sensors with `shrink` times fewer and larger pixels."""
    size = (1920 // shrink, 1200 // shrink, 5.86 * shrink)
    scale = distance_mm / 11000.0
    made = Site(
        main=CameraGeometry(*size, 800.0),
        sub=CameraGeometry(*size, 6.0),
        main_target=CirclesTarget(CENTRES_MM * scale, np.full(5, 8.0 * scale), distance_mm, 20.0),
        sub_target=CheckerboardTarget(32, 31, 2.0, 50.0),
        rig=RigPrior(np.array([0.0, 180.0, 0.0]), 1.0, np.array([0.0, 0.0, -80.0]), 3.0),
        quality=QualityLimits(),
    )
    return replace(made, **changes)


def clean(**changes: object) -> SimSettings:
    """A rig with all its departures, seen in even light, 16 bits, without noise."""
    settings = SimSettings(
        optics=Optics(main_shading=0.0, sub_shading=0.0, light_change=0.0),
        sensor=Sensor(bits=16, noise=False),
    )
    return replace(settings, **changes)


AS_DRAWN = AsBuilt(scale=0.0)


def disc_centroids(image: np.ndarray, near_px: np.ndarray, radius_px: float) -> np.ndarray:
    """Grey-weighted centroids of the discs, each in a square window about a first guess."""
    found = []
    half = round(1.4 * radius_px)
    for u, v in np.rint(near_px).astype(int):
        cut = image[v - half : v + half + 1, u - half : u + half + 1].astype(float)
        weight = cut - np.median(cut[0])
        axis = np.arange(-half, half + 1)
        found.append([u, v] + np.array([axis @ weight.sum(0), axis @ weight.sum(1)]) / weight.sum())
    return np.array(found)
