"""Opening what a session works with: cameras, head and clock, real or simulated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import timedelta

from daemon.calibration.lens_session import Bench
from daemon.calibration.positions import Limits
from daemon.calibration.session import CalibrationDevices
from daemon.config.reading import Config
from daemon.devices import open_bench, open_calibration_rig, open_clock
from daemon.readings.sampler import open_sampler
from daemon.slots.exposure import loop_of
from drivers.frameset import FrameSetRow

BEFORE_SCENARIOS = timedelta(minutes=30)
"""A simulated rig is calibrated before its scenarios begin: until then both targets rest."""


@contextmanager
def opened_devices(config: Config, before: Sequence[FrameSetRow]) -> Iterator[CalibrationDevices]:
    """Open cameras and head for a session; simulated time continues after the views before it.

    Raises as `open_calibration_rig`.
    """
    begin_utc = config.simulation.start_utc - BEFORE_SCENARIOS
    if before:
        begin_utc = max(begin_utc, before[-1].slot_utc + timedelta(seconds=1))
    clock = open_clock(config, begin_utc=begin_utc)
    opened = open_calibration_rig(config, clock)
    sampler = open_sampler(config, patient=True)
    with closing(opened.source), closing(opened.head), closing(sampler):
        yield CalibrationDevices(
            config.site(),
            opened.source,
            opened.head,
            Limits(*config.pan_tilt.room_deg()),
            clock,
            opened.hold_board,
            loop_of(config),
            sampler,
            config.camera.serials,
        )


@contextmanager
def opened_bench(config: Config) -> Iterator[Bench]:
    """Open what lens views need: the cameras, and no head."""
    begin_utc = config.simulation.start_utc - BEFORE_SCENARIOS
    clock = open_clock(config, begin_utc=begin_utc)
    source, hold_board = open_bench(config, clock)
    with closing(source):
        yield Bench(config.site(), source, clock, hold_board, loop_of(config))
