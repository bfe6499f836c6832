"""Corners by mrgingham, lens and poses by mrcal: a program for Debian's Python, which has both.

`peers_mrcal.py IN.npz OUT.npz`. IN: images (n, h, w), about_px (n, rows, columns, 2), where each
corner is to a few pixels, square_mm, focal_px, calibrates (n,). The lens and the board's warp are
fitted to the views that calibrate, then the poses of the others with these. OUT: corners_px as
about_px, nan where mrgingham has none there; rt (n, 6), rotation vector and mm from the board to
the camera; seconds (2,), CPU of finding and of fitting, a view.
"""

from __future__ import annotations

import sys
import time

import cv2
import mrcal
import mrgingham
import numpy as np

NEAR_PX = 2.0
LENS, BARE = "LENSMODEL_OPENCV5", "LENSMODEL_PINHOLE"


def find(image: np.ndarray, about_px: np.ndarray) -> np.ndarray:
    """The corner that is nearest to where each must be; mrgingham knows square grids only."""
    blurred = cv2.blur(image, (3, 3))  # as the program mrgingham does by default
    candidates = np.asarray(mrgingham.find_chessboard_corners(blurred))
    away = candidates[None] - about_px.reshape(-1, 1, 2)
    distance = np.hypot(away[..., 0], away[..., 1])
    nearest = np.array(candidates[distance.argmin(axis=1)])
    nearest[distance.min(axis=1) > NEAR_PX] = np.nan
    return nearest.reshape(about_px.shape)


def fit(given: dict[str, np.ndarray], corners_px: np.ndarray) -> np.ndarray:
    """The poses of all views (n, 6)."""
    square_mm, focal_px = float(given["square_mm"]), float(given["focal_px"])
    _, height, width = given["images"].shape
    missing = np.isnan(corners_px[..., :1])
    seen = np.concatenate([np.where(missing, 0.0, corners_px), np.where(missing, -1.0, 1.0)], -1)
    lens = np.array([[focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, *np.zeros(5)]])
    number = np.arange(len(seen), dtype=np.int32)
    indices = np.column_stack([number, 0 * number, 0 * number - 1]).astype(np.int32)
    start = mrcal.estimate_monocular_calobject_poses_Rt_tocam(
        indices[:, :2], seen, square_mm, ((BARE, lens[0, :4]),)
    )
    rt, warp = np.ascontiguousarray(mrcal.rt_from_Rt(start)), np.zeros(2)

    def optimize(views: np.ndarray, *, core: bool, rest: bool) -> None:
        frames = np.ascontiguousarray(rt[views])
        mrcal.optimize(
            intrinsics=lens,
            extrinsics_rt_fromref=np.zeros((0, 6)),
            frames_rt_toref=frames,
            points=None,
            observations_board=np.ascontiguousarray(seen[views]),
            indices_frame_camintrinsics_camextrinsics=indices[: len(views)],
            observations_point=None,
            indices_point_camintrinsics_camextrinsics=None,
            lensmodel=LENS,
            imagersizes=np.array([[width, height]], dtype=np.int32),
            calibration_object_spacing=square_mm,
            calobject_warp=warp,
            do_optimize_intrinsics_core=core,
            do_optimize_intrinsics_distortions=rest,
            do_optimize_calobject_warp=rest,
            do_optimize_frames=True,
            do_apply_regularization=core,
            do_apply_outlier_rejection=rest,
            verbose=False,
        )
        rt[views] = frames

    calibrates = np.nonzero(given["calibrates"])[0]
    optimize(calibrates, core=False, rest=False)
    optimize(calibrates, core=True, rest=False)
    optimize(calibrates, core=True, rest=True)
    optimize(np.nonzero(~given["calibrates"])[0], core=False, rest=False)
    return rt


def main() -> None:
    """Read, find, fit, write."""
    with np.load(sys.argv[1]) as file:
        given = {name: file[name] for name in file.files}
    begun_s, count = time.process_time(), len(given["images"])
    pairs = zip(given["images"], given["about_px"], strict=True)
    corners_px = np.array([find(image, about_px) for image, about_px in pairs])
    found_s = time.process_time()
    rt = fit(given, corners_px)
    seconds = np.array([found_s - begun_s, time.process_time() - found_s]) / count
    np.savez(sys.argv[2], corners_px=corners_px, rt=rt, seconds=seconds)


if __name__ == "__main__":
    main()
