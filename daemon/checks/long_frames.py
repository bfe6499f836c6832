"""What a series of frames tells of a camera: its clock, its numbers, its exposure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daemon.checks.finding import Finding
from drivers.protocols import CapturedFrame

ODD_RATE = 1e-3
"""A camera's clock off by more is no clock in ns."""
JUMP_S = 0.5
"""More than a busy computer is late with a trigger."""
FOLLOWS = 0.9
"""Correlation of brightness and exposure from which one follows the other."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A frame without its image, and what was asked for it."""

    asked_us: float
    exposure_us: float | None
    mean_dn: float
    """Of the image, in steps of its pixels."""
    frame_id: int
    camera_time_ns: int
    trigger_s: float
    """Monotonic."""


def shown(frame: CapturedFrame, asked_us: float) -> Shown:
    """Note what the report needs of a frame."""
    return Shown(
        asked_us=asked_us,
        exposure_us=frame.exposure_us,
        mean_dn=float(np.mean(frame.pixels)),
        frame_id=frame.frame_id,
        camera_time_ns=frame.camera_time_ns,
        trigger_s=frame.trigger_monotonic_s,
    )


def camera_clock(name: str, frames: Sequence[Shown]) -> Finding:
    """Compare the camera's clock with ours, from frame to frame."""
    steps = [
        (1e-9 * (b.camera_time_ns - a.camera_time_ns), b.trigger_s - a.trigger_s)
        for a, b in itertools.pairwise(frames)
    ]
    back = sum(camera_s <= 0.0 for camera_s, _ in steps)
    jumps = [camera - ours for camera, ours in steps if abs(camera - ours) > JUMP_S]
    tick = _tick(frames)
    if back or jumps:
        listed = ", ".join(f"{jump_s:+.3f} s" for jump_s in jumps)
        text = f"jumped {len(jumps)} times in {len(steps)}, {back} times back"
        text += f": {listed}" if jumps else ""
        return Finding(name, "warning", f"{text}; {tick}; dcam goes by the frames' numbers")
    camera_s, ours_s = (sum(step[i] for step in steps) for i in (0, 1))
    rate = camera_s / ours_s - 1.0 if ours_s else 0.0
    odd = max(abs(camera - ours) for camera, ours in steps)
    unsure = 2.0 * odd / ours_s if ours_s else 0.0  # our own times may be late by odd at both ends
    text = f"{round(1e6 * rate):+d} ppm beside ours over {ours_s:.0f} s, {1e3 * odd:.1f} ms at most"
    is_odd = abs(rate) >= ODD_RATE + unsure
    return Finding(name, "warning" if is_odd else "ok", f"{text}; no jump; {tick}")


def _tick(frames: Sequence[Shown]) -> str:
    step_ns = math.gcd(*(frame.camera_time_ns for frame in frames))
    return f"counts in steps of {step_ns / 1e3:g} us" if step_ns else "tells no time"


def frame_numbers(name: str, frames: Sequence[Shown]) -> Finding:
    """Whether the camera counts its frames one by one."""
    steps = sorted({b.frame_id - a.frame_id for a, b in itertools.pairwise(frames)})
    text = f"from {frames[0].frame_id} to {frames[-1].frame_id}"
    if steps == [1]:
        return Finding(name, "ok", f"{text}, one by one")
    listed = ", ".join(f"{step:+d}" for step in steps)
    return Finding(name, "warning", f"{text}, in steps of {listed}: a frame lost, or a new start")


def exposure_steps(name: str, frames: Sequence[Shown]) -> Finding:
    """What the camera made of each exposure that was asked for."""
    made = {
        frame.asked_us: "not reported" if frame.exposure_us is None else f"{frame.exposure_us:.3f}"
        for frame in frames
    }
    listed = ", ".join(f"{asked:g} -> {us}" for asked, us in sorted(made.items()))
    return Finding(name, "ok", f"us: {listed}")


def exposure_delay(name: str, frames: Sequence[Shown]) -> Finding:
    """Whether a new exposure is that of the next frame, as brightness shows."""
    means = ", ".join(
        f"{asked:g} us {np.mean([one.mean_dn for one in frames if one.asked_us == asked]):.1f}"
        for asked in sorted({one.asked_us for one in frames})
    )
    at_once = _follows([(one.asked_us, one.mean_dn) for one in frames])
    later = _follows([(a.asked_us, b.mean_dn) for a, b in itertools.pairwise(frames)])
    if max(at_once, later) < FOLLOWS:
        text = f"brightness does not follow it ({means}): too dark, too bright, or changing light"
        return Finding(name, "warning", f"{text}; take it again before the lit targets")
    if later > at_once:
        return Finding(name, "warning", f"is that of the frame after the next; mean: {means}")
    return Finding(name, "ok", f"is that of the next frame; mean: {means}")


def _follows(pairs: Sequence[tuple[float, float]]) -> float:
    """Correlation; 0 where one of both never changes."""
    asked, mean = np.array(pairs).T
    if np.ptp(asked) == 0.0 or np.ptp(mean) == 0.0:
        return 0.0
    return float(np.corrcoef(asked, mean)[0, 1])
