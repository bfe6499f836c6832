"""What the long look says of a camera's frames: clock, numbers, when a new exposure counts."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.checks.long_frames import Shown, camera_clock, exposure_delay, frame_numbers

ASKED_US = (1000.0, 1234.5, 2500.0, 5000.0) * 3


def frames(late: int = 0) -> list[Shown]:
    """Frames 7 s apart, of a camera that uses an exposure `late` frames after it was set."""
    return [
        Shown(
            asked_us=asked_us,
            exposure_us=asked_us,
            mean_dn=10.0 + 0.02 * ASKED_US[max(k - late, 0)],
            frame_id=k,
            camera_time_ns=7_000_000_000 * k,
            trigger_s=1000.0 + 7.0 * k,
        )
        for k, asked_us in enumerate(ASKED_US)
    ]


@pytest.mark.parametrize("jump_s", [-30.0, -3.0, 2.0, 128.0])
def test_a_clock_that_jumps_is_a_warning_with_the_jump(jump_s: float) -> None:
    series = frames()
    later = [
        replace(one, camera_time_ns=one.camera_time_ns + int(1e9 * jump_s)) for one in series[6:]
    ]
    found = camera_clock("main clock", series[:6] + later)
    assert found.state == "warning"
    assert f"{jump_s:+.3f} s" in found.text
    assert f"{int(jump_s < -7.0)} times back" in found.text


def test_a_steady_clock_is_given_with_its_rate_and_step() -> None:
    found = camera_clock("main clock", frames())
    assert (found.state, found.name) == ("ok", "main clock")
    assert "+0 ppm beside ours over 77 s" in found.text
    assert "counts in steps of 7e+06 us" in found.text


def test_a_frame_number_left_out_is_a_warning() -> None:
    series = frames()
    assert frame_numbers("main numbers", series).text == "from 0 to 11, one by one"
    found = frame_numbers("main numbers", [one for one in series if one.frame_id != 4])
    assert (found.state, "steps of +1, +2" in found.text) == ("warning", True)


def test_an_exposure_that_counts_one_frame_late_is_seen_in_the_brightness() -> None:
    assert exposure_delay("main new exposure", frames()).state == "ok"
    late = exposure_delay("main new exposure", frames(late=1))
    assert late.state == "warning"
    assert "is that of the frame after the next" in late.text


def test_a_dark_image_does_not_tell_when_an_exposure_counts() -> None:
    dark = [replace(one, mean_dn=9.0) for one in frames()]
    found = exposure_delay("main new exposure", dark)
    assert (found.state, "does not follow" in found.text) == ("warning", True)
