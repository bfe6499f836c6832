"""A station on a file system of its own, which fills up or fails; run in its own mount namespace.

`failing_disk.py full|readonly DIRECTORY`: what became of it is the last line on stdout, as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from daemon.disk.reserve import NAME
from daemon.disk.rules import Rules
from tests.daemon.conftest import Station

RULES = Rules(min_free_gb=0.0, reserve_mb=6)


def command(*words: str | Path) -> None:
    subprocess.run([str(word) for word in words], check=True, capture_output=True)


def make_disk(image: Path, place: Path, size: str) -> None:
    """A small real ext4 that turns read-only when it fails, as a root file system does."""
    place.mkdir()
    command("truncate", "-s", size, image)
    command("mkfs.ext4", "-q", "-F", image)
    mount(image, place)


def mount(image: Path, place: Path) -> None:
    command("mount", "-o", "loop,errors=remount-ro", image, place)


def fill(place: Path, left_kb: int) -> None:
    """Another program takes all but so much."""
    with (place / "ballast").open("ab", buffering=0) as ballast:
        while (rest := free_kb(place) - left_kb) > 0:
            try:
                ballast.write(bytes(1024 * min(rest, 256)))
            except OSError:
                return


def free_kb(place: Path) -> int:
    words = subprocess.check_output(["stat", "-f", "-c", "%a %S", place], text=True).split()
    return int(words[0]) * int(words[1]) // 1024


def full(directory: Path) -> dict[str, object]:
    """Frames stop, rows go on, into the reserve at last; then the other program ends."""
    place = directory / "disk"
    make_disk(directory / "image", place, "40M")
    seen: dict[str, object] = {}
    station = Station(place / "state", rules=RULES)
    reserve = place / "state" / NAME

    def note(name: str) -> None:
        seen[name] = {"reserve": reserve.exists(), "free_kb": free_kb(place)}

    def act(name: str, what: Callable[[], object]) -> Callable[[], None]:
        def order() -> None:
            note(name)
            what()

        return order

    station.run(
        300,
        {
            10: act("at first", lambda: fill(place, 5000)),
            20: act("without frames", lambda: fill(place, 0)),
            200: act("in the reserve", (place / "ballast").unlink),
            299: act("at last", lambda: None),
        },
    )
    return seen | story(station)


def readonly(directory: Path) -> dict[str, object]:
    """The file system aborts as after a bad write; an operator checks it and mounts it again."""
    image, place = directory / "image", directory / "disk"
    make_disk(image, place, "40M")
    station = Station(place / "state", rules=RULES)

    def abort() -> None:
        command("mount", "-o", "remount,abort", place)

    def repair() -> None:
        command("umount", "-l", place)

    def again() -> None:
        subprocess.run(["e2fsck", "-fy", str(image)], check=False, capture_output=True)
        mount(image, place)

    station.run(40, {10: abort, 20: repair, 30: again})
    result = story(station) | {"left_behind": [path.name for path in place.iterdir()]}
    command("umount", "-l", place)
    return result | {"under_the_mount": [str(path) for path in place.rglob("*")]}


def story(station: Station) -> dict[str, object]:
    there = {slot.isoformat() for slot in station.archive.stored_slots()}
    rows = list(station.store.measurements())
    told = {
        "rows": len(rows),
        "gaps": station.gaps(),
        "with_frames": [
            number for number, row in enumerate(rows) if row.slot_utc.isoformat() in there
        ],
        "named": [number for number, row in enumerate(rows) if row.main_frame is not None],
        "removed": [
            number for number, row in enumerate(rows) if station.store.frames_removed(row.slot_utc)
        ],
        "events": [event.kind for event in station.store.events()],
    }
    station.store.close()
    return told


if __name__ == "__main__":
    scenario = {"full": full, "readonly": readonly}[sys.argv[1]]
    sys.stdout.write(json.dumps(scenario(Path(sys.argv[2]))) + "\n")
