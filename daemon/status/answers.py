"""What an engineer asks first, in this order, each answered in a line or two."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from core.site import TargetRole
from daemon.status.facts import Disk, Facts
from daemon.status.item import Item, Level, worst
from daemon.store.records import Coverage
from daemon.text import bytes_text, span_text, utc_text
from daemon.value_text import displacement_text, value_text

_TODO = {
    "measurement": "journalctl -u dcamd tells why",
    "last good value": "dcam-ctl preview shows what the cameras see",
    "daemon": "systemctl start dcamd",
    "supervision": "journalctl -u dcamd tells more",
    "cameras": "check power and cables, then dcam-ctl check --hardware",
    "readings": "check the sensor and its cable",
    "calibration": "dcam-ctl calibrate makes another",
    "coverage 24 h": "dcam-ctl gaps tells why",
    "coverage 30 d": "dcam-ctl gaps tells why",
    "frames": "free some space",
    "clock": "look at timedatectl",
    "alarms": "dcam-ctl alarm list tells more",
}
"""What to do about a thing whose own line may not say it."""
_SAYS_TODO = re.compile(
    "dcam-ctl|journalctl|start dcamd|chronyc|calibrate again|free some space|none yet|clock wrong"
)
_FIRST = (Level.CRITICAL, Level.WARNING, Level.UNKNOWN)
"""In which order it says what is wrong."""
_YEARS_FROM = 1000
"""Days that are said as years from here on."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A question's word and what is said to it."""

    word: str
    text: str
    level: Level = Level.OK


def answers(facts: Facts, items: Sequence[Item]) -> Iterator[Answer]:
    """Is it measuring, how old and what is the last value, what is wrong, how complete, how long.

    items are the verdict's, all of them.
    """
    by_name = {item.name: item for item in items}
    yield _measuring(facts, by_name)
    good = by_name["last good value"]
    yield Answer("last good", good.text, good.level)
    yield from _value(facts, by_name)
    wrong = [item for item in items if item.level is not Level.OK]
    wrong.sort(key=lambda item: _FIRST.index(item.level))
    for word, item in zip(("wrong", *[""] * len(wrong)), wrong, strict=False):
        yield Answer(word, f"{item.name}: {_with_todo(item)}", item.level)
    if not wrong:
        yield Answer("wrong", "nothing")
    coverage = [by_name["coverage 24 h"], by_name["coverage 30 d"]]
    shares = f"{_share(facts.coverage_24h)} in 24 h, {_share(facts.coverage_30d)} in 30 d"
    yield Answer("complete", shares, worst(coverage))
    yield Answer("disk", _disk(facts.disk), by_name["disk"].level)


def _measuring(facts: Facts, by_name: dict[str, Item]) -> Answer:
    daemon, row = by_name["daemon"], by_name["measurement"]
    if facts.last is None:
        return Answer("measuring", f"no row yet; daemon: {daemon.text}", worst([daemon, row]))
    age = span_text((facts.now_utc - facts.last.slot_utc).total_seconds())
    cameras, says = by_name["cameras"], facts.daemon.says
    if daemon.level is Level.OK and cameras.level is Level.CRITICAL:
        return Answer("measuring", f"no, last slot {age} ago; {cameras.text}", cameras.level)
    if daemon.level is Level.OK and says is not None and says.phase != "running":
        return Answer(
            "measuring", f"not now, last slot {age} ago; daemon: {daemon.text}", row.level
        )
    if daemon.level is Level.OK and row.level is Level.OK:
        return Answer("measuring", f"yes, last slot {age} ago")
    word = "not known" if daemon.level is Level.UNKNOWN else "no"
    text = f"{word}, last slot {age} ago; daemon: {daemon.text}"
    return Answer("measuring", text, worst([daemon, row]))


def _value(facts: Facts, by_name: dict[str, Item]) -> Iterator[Answer]:
    """The last good value: main target, further points, and what fixed targets show.

    The last row is given where it is not good, too: it says why.
    """
    if facts.last is None:
        return
    shown = facts.last_good or facts.last
    yield Answer("value", f"{value_text(shown.measurement)}, {utc_text(shown.slot_utc)}")
    if shown is not facts.last:
        yield Answer("", f"last row: {value_text(facts.last.measurement)}")
    for now in shown.measurement.targets:
        if now.role is TargetRole.MEASURED and now.corrected is not None:
            yield Answer("", f"{now.name}: {displacement_text(now.corrected)}")
    closure = by_name.get("closure")
    if closure is not None and closure.level is Level.OK:
        yield Answer("", f"closure: {closure.text}")


def _with_todo(item: Item) -> str:
    """An item's line with what to do about it; many say it themselves."""
    todo = _TODO.get(item.name)
    return item.text if todo is None or _SAYS_TODO.search(item.text) else f"{item.text}; {todo}"


def _share(coverage: Coverage) -> str:
    if not coverage.expected:
        return "no slot"
    return f"{coverage.measured / coverage.expected:.1%} of {coverage.expected} slots"


def _disk(disk: Disk) -> str:
    """How long it lasts."""
    free = f"{bytes_text(disk.free_bytes)} of {bytes_text(disk.total_bytes)} free"
    if disk.frames_fit:
        return f"lasts for all that retention keeps, {free}"
    if disk.days_left is None:
        return free
    left = disk.days_left
    span = f"{left / 365:.0f} years" if left > _YEARS_FROM else f"{left:.0f} days"
    return f"{span} until frames are thinned early, {free}"
