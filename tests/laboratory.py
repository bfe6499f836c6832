"""The laboratory's config as text, on sensors of any number of pixels."""

from __future__ import annotations

SENSOR_MM = 1920 * 5.86e-3
"""Width; fewer pixels are larger ones."""


def laboratory(width_px: int, backend: str = "", *, square_mm: float = 2.0) -> str:
    """The minimal site, 11 m from its target, both cameras `width_px` wide and of `backend`.

    Cameras that are found by their number are 15290000 and 15290001; the board's size is kept.
    """
    cameras = "".join(
        _camera(role, width_px, focal_length_mm, serial, backend)
        for role, focal_length_mm, serial in (("main", 800.0, 15290000), ("sub", 6.0, 15290001))
    )
    return f"""
[site]
name = "bench"
{cameras}
[target.main]
kind = "circles"
centres_mm = [[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]
diameter_mm = 8.0
distance_mm = 11000.0
distance_sigma_mm = 20.0

[target.sub]
kind = "checkerboard"
squares_x = {int(64 // square_mm)}
squares_y = {int(62 // square_mm)}
square_mm = {square_mm}
distance_mm = 50.0

[rig]
rotation_main_sub_deg = [0.0, 180.0, 0.0]
rotation_sigma_deg = 1.0
offset_main_sub_mm = [0.0, 0.0, -80.0]
offset_sigma_mm = 3.0
"""


def _camera(role: str, width_px: int, focal_length_mm: float, serial: int, backend: str) -> str:
    lines = [f"[camera.{role}]"]
    if backend:
        lines.append(f'backend = "{backend}"')
    if backend in {"aravis", "harvesters"}:
        lines.append(f'serial = "{serial}"')
    lines += [
        f"width_px = {width_px}",
        f"height_px = {width_px * 5 // 8}",
        f"pixel_pitch_um = {1e3 * SENSOR_MM / width_px:.5g}",
        f"focal_length_mm = {focal_length_mm}",
    ]
    return "\n" + "\n".join(lines) + "\n"
