"""`dcamd` whose images are rendered once for each condition: months of slots in little time.

Everything else is the daemon's own: slot loop, pair of cameras, archive, database, control socket.
Arguments: the boot it is to say it runs in; of how many looks at the same pair of images one is
measured again, the others being given the same result; for how many minutes of fair weather the
same image is shown on end; then those of `dcamd`.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime
from typing import Any, ClassVar, NoReturn

from core.results import Measurement
from core.site import QualityLimits, Site
from daemon import main
from daemon.clock import machine
from daemon.slots import measuring, row_history
from daemon.slots.measuring import ActiveCalibration, ImagePair
from daemon.slots.row_history import RowHistory, stored_step_detector
from daemon.store.database import Store
from drivers.protocols import Image, Role
from drivers.sim import world
from drivers.sim.settings import DISTURBANCES, SimSettings

OTHER_MIN = 240
"""How long the same image is shown on end in other weather."""
_DAY_MIN = 1440


class RenderedOnce(world.World):
    """A world in which every day is like the first one of its weather."""

    fair_min: ClassVar = 0
    """How long the same image is shown on end in fair weather."""

    def __init__(self, site: Site, settings: SimSettings) -> None:
        self._shown: dict[tuple[Any, ...], Image] = {}
        super().__init__(site, settings)

    def render(self, role: Role, t_utc: datetime, *how: Any) -> Image:
        """Render the first image of such a moment; show that one ever after."""
        minute = int(self._minute(t_utc)) % _DAY_MIN
        cases = tuple(kind for kind in DISTURBANCES if self.active(kind, t_utc, role))
        past = minute % (OTHER_MIN if cases else self.fair_min)
        moment = role, cases, minute - past, how
        if moment not in self._shown:
            self._shown[moment] = super().render(role, t_utc, *how)
        return self._shown[moment]


class MeasuredAgain:
    """Measures the same images of the same calibration now and then only."""

    def __init__(self, every: int) -> None:
        self._every = every
        self._looks: Counter[tuple[int, ...]] = Counter()
        self._results: dict[tuple[int, ...], Measurement] = {}

    def measure(
        self,
        pairs: Iterable[ImagePair],
        site: Site,
        calibration: ActiveCalibration | None,
        *_: object,
    ) -> Measurement:
        """Stand in for `measuring.measure`. Raises RuntimeError if a result changes.

        The moment is left out, with which sigma grows.
        """
        (pair,) = pairs
        assert pair.main is not None
        assert pair.sub is not None
        # The images are kept for good, so that no other one can come to lie in their place.
        key = (id(pair.main.pixels), id(pair.sub.pixels), (calibration and calibration.id) or 0)
        looks, self._looks[key] = self._looks[key], self._looks[key] + 1
        if looks % self._every == 0:
            result = measuring.measure([replace(pair, moment=None)], site, calibration)
            if repr(self._results.setdefault(key, result)) != repr(result):
                msg = "the same images were measured twice, and not alike"
                raise RuntimeError(msg)
        return self._results[key]


class Remembered:
    """Judges a row by those before it without reading them again: a slot then takes a third."""

    def __init__(self) -> None:
        self._sequence: RowHistory | None = None

    def judge_in_history(
        self,
        store: Store,
        calibration: ActiveCalibration | None,
        limits: QualityLimits,
        slot_utc: datetime,
        measurement: Measurement,
    ) -> Measurement:
        """Stand in for `daemon.slots.row_history.judge_in_history`, of one calibration."""
        if calibration is None or measurement.corrected is None:
            return measurement
        if self._sequence is None:
            so_far = stored_step_detector(store, calibration, slot_utc)
            self._sequence = RowHistory(calibration, limits, so_far)
        return self._sequence.judge(slot_utc, measurement)


def run() -> NoReturn:
    """Run `dcamd` on such a world, and end with its exit code."""
    boot_id, every = sys.argv.pop(1), int(sys.argv.pop(1))
    RenderedOnce.fair_min = int(sys.argv.pop(1))
    for module, name, stand_in in (
        (machine, "read_boot_id", lambda: boot_id),
        (row_history, "measure", MeasuredAgain(every).measure),
        (row_history, "judge_in_history", Remembered().judge_in_history),
        (world, "World", RenderedOnce),
    ):
        setattr(module, name, stand_in)
    main.main()


if __name__ == "__main__":
    run()
