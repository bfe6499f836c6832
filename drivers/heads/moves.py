"""What every pan-tilt head needs whatever it speaks: limits, arrival, and a halt when a move fails.

Times are those of the head's line (`Line.monotonic_s`); listening to the line is how they pass.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from drivers.errors import HeadError, HeadLimitError, HeadLostError, HeadUnreachedError
from drivers.heads.serial_line import Line
from drivers.protocols import HeadSettings

Position = tuple[float, float]
"""Pan and tilt, degrees."""

AXES = ("pan", "tilt")
POLL_S = 0.05
"""Between two questions where the head is."""
STALL_S = 3.0
"""A head that has not moved for so long, and is not where it should be, is stuck."""
REST_S = 1.0
"""A head that has not moved for so long, and is near enough, has come to rest there."""
SAME_DEG = 1e-6


def renew(line: Line) -> None:
    """Open the line; one that died while nobody used it is opened again. Raises HeadLostError."""
    if line.openings:
        with suppress(HeadLostError):  # it is closed now
            line.read(0.0)
    line.open()


def require_within(
    who: str, limits_deg: tuple[Position, Position], asked_deg: Position, advice: str = ""
) -> None:
    """Raise HeadLimitError for an angle beyond its limits; also for one that is no number."""
    for axis, (low, high), angle in zip(AXES, limits_deg, asked_deg, strict=True):
        if not low <= angle <= high:
            what = advice or f"ask for less, or change pan_tilt.{axis}_limits_deg"
            msg = (
                f"{who}: {axis} {angle:g} deg is beyond its limits of {low:g} to {high:g} deg; "
                f"{what}"
            )
            raise HeadLimitError(msg)


def require_unmoved(
    who: str, rested_deg: Position | None, now_deg: Position, tolerance_deg: float
) -> None:
    """Raise HeadError when the head is no longer where it came to rest.

    A head that restarts without homing says 0 wherever it stands: its limits are off by as much.
    """
    if rested_deg is None or _is_near(now_deg, rested_deg, 2.0 * tolerance_deg):
        return
    msg = (
        f"{who}: came to rest at {_text(rested_deg)}, but now says {_text(now_deg)}: it restarted "
        "after a power cut, or something else moved it. Look where the rig points before you go "
        "on; if it is off, switch the head off and on with the way clear, and aim again"
    )
    raise HeadError(msg)


@contextmanager
def halted_on_error(who: str, halt: Callable[[], None]) -> Iterator[None]:
    """Halt the head when the block fails, be it by Ctrl-C, and say so when even that failed."""
    try:
        yield
    except (HeadLimitError, HeadUnreachedError):  # nothing has moved
        raise
    except BaseException as error:
        try:
            halt()
        except HeadError as unhalted:
            msg = (
                f"{str(error) or type(error).__name__}. It could not be halted: {unhalted}. "
                f"Cut the power of {who} if it still turns"
            )
            raise type(error)(msg) if isinstance(error, HeadError) else HeadError(msg) from error
        raise


def listen(line: Line, seconds: float, abort: threading.Event) -> bytes:
    """Let time pass while bytes may come; ends early when `abort` is set. Raises HeadLostError."""
    until_s = line.monotonic_s() + seconds
    heard = b""
    while not abort.is_set() and (left_s := until_s - line.monotonic_s()) > 0.0:
        heard += line.read(min(left_s, POLL_S))
    return heard


def wait_until_there(
    who: str,
    line: Line,
    where: Callable[[], Position],
    asked_deg: Position,
    settings: HeadSettings,
    abort: threading.Event,
    unasked: Callable[[bytes], None] = lambda _: None,
) -> None:
    """Ask where the head is until it is there, or rests near enough. Raises HeadError.

    `asked_deg` is a place that the head can report exactly; said twice it has arrived. `unasked`
    is given the bytes that come between two questions.
    """
    last, changed_s = where(), line.monotonic_s()
    deadline_s = changed_s + settings.move_timeout_s
    while True:
        unasked(listen(line, POLL_S, abort))
        if abort.is_set():
            msg = f"{who}: halted on its way to {_text(asked_deg)}"
            raise HeadError(msg)
        now, now_s = where(), line.monotonic_s()
        if now != last:
            last, changed_s = now, now_s
        elif _is_near(now, asked_deg, SAME_DEG):
            return
        still_s = now_s - changed_s
        if still_s > REST_S and _is_near(now, asked_deg, settings.tolerance_deg):
            return
        if still_s > STALL_S:
            msg = (
                f"{who}: stuck at {_text(now)} on its way to {_text(asked_deg)}; look for what "
                "blocks it, its cables first, and whether it lost power for a moment"
            )
            raise HeadError(msg)
        if now_s > deadline_s:
            msg = (
                f"{who}: not at {_text(asked_deg)} within {settings.move_timeout_s:g} s, it is at "
                f"{_text(now)}; raise pan_tilt.move_timeout_s, or pan_tilt.speed_deg_s"
            )
            raise HeadError(msg)


def _is_near(one: Position, other: Position, tolerance_deg: float) -> bool:
    return all(abs(a - b) <= tolerance_deg for a, b in zip(one, other, strict=True))


def _text(position: Position) -> str:
    return f"pan {position[0]:.3f} tilt {position[1]:.3f} deg"
