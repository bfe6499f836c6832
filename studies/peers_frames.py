"""The laboratory's frames through other programs, where this computer has them."""

from __future__ import annotations

import os
import resource
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.calibration.joint_fit import Method, nominal_rig
from core.calibration.views import LensView, PairView, Views
from core.checkerboard.corners import LocatedBoard
from core.geometry.pose import Pose
from core.rig.compensation import affine
from core.rig.paper import fit_paper
from studies.laboratory_frames import OPENCV_SIGMA_PX, Located, locate, tests_of

HERE = Path(__file__).parent
PYTHON = "/usr/bin/python3"
"""Debian's, for which python3-mrcal and python3-mrgingham are made."""
COMPILER = "g++"
PACKAGES = "python3-mrcal python3-mrgingham libvisp-blob-dev g++"
DETECTORS, CHAIN = "mrgingham, ViSP", "mrgingham, ViSP; mrcal"


def has_programs() -> bool:
    """Whether all of PACKAGES is there."""
    asked = [PYTHON, "-c", "import mrcal, mrgingham"]
    with tempfile.TemporaryDirectory() as scratch:
        try:
            found = subprocess.run(asked, capture_output=True, check=False)
            return found.returncode == 0 and _dots_program(Path(scratch)) is not None
        except OSError:
            return False


def _dots_program(directory: Path) -> Path | None:
    program = directory / "dots"
    words: list[str | Path] = [COMPILER, "-O2", "-w", HERE / "peers_dots.cpp", "-o", program]
    libraries = ["-lvisp_blob", "-lvisp_core"]
    built = subprocess.run([*words, *libraries], capture_output=True, check=False)
    return program if built.returncode == 0 else None


def compute(positions: int, lens_views: int, seed: int, shrink: float = 1.0) -> dict[str, Any]:
    """Errors (mm) by detectors and fit, and times; called where `has_programs`."""
    return compare(locate(positions, lens_views, seed, shrink))


def compare(ours: Located) -> dict[str, Any]:
    """As `compute`, of frames that were rendered."""
    with tempfile.TemporaryDirectory() as scratch:
        dots_px, dots_s = locate_dots(ours, Path(scratch))
        board = locate_and_fit_board(ours, Path(scratch))
    views = _with_points(ours.views, board.corners_px, dots_px)
    seconds = board.finding_s + dots_s
    errors: dict[str, Any] = {
        f"{DETECTORS}, {method.value}": {
            "mm": ours.errors_mm(views, method),
            "locating_s": seconds,
        }
        for method in (Method.PAPER, Method.RIGID)
    }
    mm = errors_with_poses_mm(ours, views, board.poses)
    errors[f"{CHAIN}, paper"] = {"mm": mm, "locating_s": seconds + board.fitting_s}
    missing = float(np.isnan(board.corners_px[..., 0]).mean())
    return {"errors": errors, "corners_missing": missing}


def locate_dots(ours: Located, scratch: Path) -> tuple[dict[str, FloatArray], float]:
    """Centres (n, 2) of the discs by view, and the CPU time of an image, by ViSP's vpDot2."""
    program = _dots_program(scratch)
    if program is None:
        msg = f"peers: {COMPILER} does not compile peers_dots.cpp; apt-get install {PACKAGES}"
        raise RuntimeError(msg)
    lines, pairs = [], [ours.views.reference, *ours.views.rig]
    for number, view in enumerate(pairs):
        pixels = ours.images[view.name].pixels
        file = scratch / f"{number}.raw"
        file.write_bytes(pixels.tobytes())
        lines.append(f"{file} {pixels.shape[1]} {pixels.shape[0]} {len(view.discs.points_px)}")
        lines += [f"{u} {v}" for u, v in np.round(view.discs.points_px)]
    before_s = _children_s()
    text = "\n".join(lines)
    ran = subprocess.run([program], input=text, stdout=subprocess.PIPE, text=True, check=True)
    seconds = (_children_s() - before_s) / len(pairs)
    points_px = np.array([line.split() for line in ran.stdout.splitlines()], dtype=float)
    places = np.cumsum([len(view.discs.points_px) for view in pairs])[:-1]
    return dict(
        zip([view.name for view in pairs], np.split(points_px, places), strict=True)
    ), seconds


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@dataclass(frozen=True, slots=True)
class BoardByOthers:
    """What mrgingham and mrcal make of the sub-camera's images."""

    corners_px: FloatArray
    """(views, corners, 2), in the order of `Views.all` and of the board; nan: not found."""
    poses: list[Pose]
    """From the board to the camera."""
    finding_s: float
    fitting_s: float


def locate_and_fit_board(ours: Located, scratch: Path) -> BoardByOthers:
    """Corners by mrgingham, lens and poses by mrcal."""
    board, views = ours.options.board, ours.views.all
    about_px = np.full((len(views), board.rows * board.columns, 2), -1e6)
    for place, view in zip(about_px, views, strict=True):
        place[view.board.view.index] = view.board.view.points_px
    test = {view.name for view in tests_of(ours.views)}
    np.savez(
        scratch / "in.npz",
        images=np.array([view.sub.pixels for view in views]),
        about_px=about_px.reshape(len(views), board.rows, board.columns, 2),
        square_mm=board.square_mm,
        focal_px=ours.site.sub.focal_px,
        calibrates=np.array([view.name not in test for view in views]),
    )
    words: list[str | Path] = [
        PYTHON,
        HERE / "peers_mrcal.py",
        scratch / "in.npz",
        scratch / "out.npz",
    ]
    subprocess.run(words, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    with np.load(scratch / "out.npz") as out:
        finding_s, fitting_s = map(float, out["seconds"])
        poses = [Pose(Rotation.from_rotvec(rt[:3]).as_matrix(), rt[3:]) for rt in out["rt"]]
        return BoardByOthers(out["corners_px"].reshape(about_px.shape), poses, finding_s, fitting_s)


def _with_points(views: Views, corners_px: FloatArray, dots_px: dict[str, FloatArray]) -> Views:
    """The same views with others' corners and discs."""
    corners = {view.name: px for view, px in zip(views.all, corners_px, strict=True)}

    def seen(view: LensView) -> LocatedBoard:
        index = np.nonzero(~np.isnan(corners[view.name][:, 0]))[0]
        located = replace(
            view.board.view,
            index=index,
            points_px=corners[view.name][index],
            covariance_px2=_covariance_px2(len(index)),
        )
        return replace(view.board, view=located)

    def pair(view: PairView) -> PairView:
        points_px = dots_px[view.name]
        covariance = _covariance_px2(len(points_px))
        discs = replace(view.discs, points_px=points_px, covariance_px2=covariance)
        return replace(view, board=seen(view), discs=discs)

    lens = tuple(replace(view, board=seen(view)) for view in views.lens)
    return Views(pair(views.reference), tuple(map(pair, views.rig)), lens)


def _covariance_px2(count: int) -> FloatArray:
    return np.tile(OPENCV_SIGMA_PX**2 * np.eye(2), (count, 1, 1))


def errors_with_poses_mm(ours: Located, views: Views, poses: Sequence[Pose]) -> list[list[float]]:
    """Errors at the test, (positions, 2), by the paper's Eq. 17-19 on poses of mrcal's."""
    reference_px = views.reference.discs.points_px
    site = ours.site
    B = affine(site.main_target.centres_mm, reference_px)[0]
    moved = {
        view.name: (
            pose.compose(poses[0].inverse()),
            (view.discs.points_px - reference_px).mean(axis=0),
        )
        for view, pose in zip(views.rig, poses[1:], strict=False)
    }
    test = [view.name for view in tests_of(views)]
    motions, shifts_px = zip(
        *(found for name, found in moved.items() if name not in test), strict=True
    )
    drawn = nominal_rig(site, B)
    middle_px = reference_px.mean(axis=0)[None]
    p_CS1 = drawn.T_CM_CS.inverse().apply(drawn.target_points_CM1(middle_px))[0]
    start_B = drawn.scale_px_per_mm * drawn.T_CM_CS.R[:2]
    model = fit_paper(motions, np.array(shifts_px), start_B, p_CS1)
    left_px = [moved[name][1] - model.shift(moved[name][0]) for name in test]
    mm: list[list[float]] = np.linalg.solve(B, np.array(left_px).T).T.tolist()
    return mm
