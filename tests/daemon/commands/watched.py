"""A simulated rig that is watched while its calibration's views are taken."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from daemon.calibration.positions import ZERO, Limits
from daemon.calibration.session import CalibrationDevices, Session, take_views
from daemon.config.reading import load_config
from daemon.devices import open_clock, open_simulated_rig
from drivers.frameset import FrameSet
from drivers.protocols import CapturedPair
from drivers.sim.world import World

BEGIN = datetime(2026, 2, 28, 23, tzinfo=UTC)
HASH = "hash"


@dataclass
class Watched:
    """A simulated rig that tells what was done to it, and to which things can be done."""

    devices: CalibrationDevices
    world: World
    moves: list[tuple[float, float]] = field(default_factory=list)
    captures: int = 0
    exposures: list[tuple[str, float, float | None]] = field(default_factory=list)
    halted: int = 0
    spoil: Callable[[int, CapturedPair], CapturedPair] = lambda _number, pair: pair
    swing: Callable[[int], tuple[float, float]] = lambda _since: ZERO
    """Degrees off the head's position, by the number of looks since the last move."""
    _since: int = 0

    # the head
    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        self.moves.append((pan_deg, tilt_deg))
        self._since = 0

    def position_deg(self) -> tuple[float, float]:
        return self.moves[-1]

    def halt(self) -> None:
        self.halted += 1

    # the cameras
    def prepare(self) -> None:
        pass

    def set_exposure(self, role: str, exposure_us: float, gain_db: float | None) -> None:
        self.exposures.append((role, exposure_us, gain_db))
        self.true_source.set_exposure(role, exposure_us, gain_db)

    def capture(self, slot_utc: datetime) -> CapturedPair:
        off = self.swing(self._since)
        self.world.turn_head(self.moves[-1][0] + off[0], self.moves[-1][1] + off[1])
        self._since += 1
        self.captures += 1
        return self.spoil(self.captures, self.true_source.capture(slot_utc))

    def close(self) -> None:
        pass


def watched(config: Path) -> Watched:
    loaded = load_config(config)
    clock = open_clock(loaded, begin_utc=BEGIN)
    devices = open_simulated_rig(loaded, clock)
    made = Watched(None, devices.world)
    made.true_source = devices.source
    made.devices = CalibrationDevices(loaded.site(), made, made, Limits(5.0, 5.0), clock, None)
    return made


def take(
    made: Watched, state: Path, resume: Session | None = None, lens: FrameSet | None = None
) -> tuple[Session, list[str]]:
    troubles: list[str] = []
    session = take_views(
        made.devices, state, HASH, lens, resume, lambda _step: None, troubles.append
    )
    return session, troubles
