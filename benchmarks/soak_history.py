"""What happens to the soak's site: the weather of the published site, shortened with the days."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

START_UTC = datetime(2026, 3, 1, tzinfo=UTC)
MINUTE = timedelta(minutes=1)
SITE = Path(__file__).with_name("soak.toml")
DAY_MIN = 1440

Window = tuple[str, int, int, int]
"""Kind, and its role if any; first minute, minutes, and days until it comes again."""

WEATHER: tuple[Window, ...] = (
    ("drift", 0, 0, 0),
    ("bridge", 0, 0, 0),
    ("night", 0, 300, 0),
    ("night", 1140, 600, 1),
    ("snow", 320, 220, 9),
    ("insect_main", 600, 15, 2),
    ("insect_sub", 700, 12, 3),
    ("camera_loss sub", 780, 7, 10),
    ("camera_loss main", 840, 3, 17),
)
PAUSE_MIN, PAUSE_DAYS = 660, 30
"""Each month somebody calibrates, from this minute of the day on."""


@dataclass(frozen=True, slots=True)
class History:
    """So many days, of which the power is away for some."""

    days: int
    dark_from: datetime
    """The power fails just after this slot."""
    dark_until: datetime
    """Power is back by this slot."""
    period: timedelta = MINUTE
    """From slot to slot."""

    @classmethod
    def of(
        cls,
        days: int,
        dark_days: float,
        bright_days: float | None = None,
        period: timedelta = MINUTE,
    ) -> History:
        """Put the power failure after so many days, or in the middle; its ends by day."""
        before = (days - dark_days) / 2.0 if bright_days is None else bright_days
        dark_from = START_UTC + timedelta(minutes=round(DAY_MIN * before))
        dark_until = dark_from + timedelta(minutes=round(DAY_MIN * dark_days))
        return cls(days, dark_from, dark_until, period)

    @property
    def end_utc(self) -> datetime:
        """The first slot that is not run any more."""
        return START_UTC + timedelta(days=self.days)

    @property
    def slots(self) -> int:
        """All slots, with those without power."""
        return timedelta(days=self.days) // self.period

    def dark(self, slot_utc: datetime) -> bool:
        """Tell whether there is no power at a slot."""
        return self.dark_from < slot_utc < self.dark_until

    def powered(self) -> list[datetime]:
        """The slots with power."""
        every = (START_UTC + number * self.period for number in range(self.slots))
        return [slot for slot in every if not self.dark(slot)]

    def camera_lost(self, slot_utc: datetime) -> bool:
        """Tell whether a camera is gone at a slot."""
        minute = (slot_utc - START_UTC) // MINUTE
        return any(
            (minute - first) % (days * DAY_MIN) < lasting and minute >= first
            for kind, first, lasting, days in WEATHER
            if kind.startswith("camera_loss")
        )

    def pauses(self) -> list[datetime]:
        """The slots after which somebody calibrates."""
        days = range(0, self.days, PAUSE_DAYS)
        slots = [START_UTC + timedelta(days=day, minutes=PAUSE_MIN) for day in days]
        return [slot for slot in slots if not self.dark(slot)]

    def config(self, clock_start_utc: datetime) -> str:
        """Give the site's config, as TOML."""
        text = SITE.read_text(encoding="utf-8")
        text += f"\n[schedule]\nperiod_s = {self.period.total_seconds():g}\n"
        text += f"\n[simulation]\nclock_start_utc = {clock_start_utc:%Y-%m-%dT%H:%M:%SZ}\n"
        for kind, first, lasting, days in WEATHER:
            name, _, role = kind.partition(" ")
            text += f'[[simulation.scenarios]]\nkind = "{name}"\nstart_min = {first}\n'
            text += f'role = "{role}"\n' if role else ""
            text += f"end_min = {first + lasting}\n" if lasting else ""
            text += f"repeat_min = {days * DAY_MIN}\n" if days else ""
        return text
