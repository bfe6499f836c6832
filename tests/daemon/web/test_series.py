"""The record in pieces: every row is in one, and what changes in the record changes here."""

from __future__ import annotations

import shutil
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from daemon.store.database import open_store, open_store_readonly
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.web.follower import Follower
from daemon.web.pyramid import EPOCH_S, LEVELS
from tests.daemon.store.examples import PERIOD_S, START, calibration, datum, slot
from tests.daemon.web.site import (
    DARK,
    PEAK,
    PEAK_MM,
    ROWS,
    SINCE,
    UNTIL,
    copy_record,
    page,
    row,
    y_mm,
)

Y = "y_mm.main"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("record")
    copy_record(tmp_path_factory, directory)
    return directory


@pytest.fixture
def state(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made / "state", tmp_path / "state")
    return tmp_path / "state"


@pytest.fixture
def follower(state: Path, tmp_path: Path) -> Follower:
    follower = Follower(state, tmp_path / "cache", PERIOD_S)
    follower.look()
    return follower


def held(follower: Follower, level: int, quantity: str = Y) -> np.ndarray:
    """All buckets of a level that hold anything, from the day before the record on."""
    width_s = follower.pyramid.width_s(level)
    first = (int(START.timestamp()) - EPOCH_S) // width_s - 86_400 // width_s
    found = follower.pyramid.read(level, quantity, first, 10 * 86_400 // width_s + 2)
    return found[found["count"] > 0]


def test_every_level_holds_every_value(follower: Follower) -> None:
    values = np.array([y_mm(number) for number in range(ROWS) if number not in DARK])
    for level in range(LEVELS):
        found = held(follower, level)
        assert found["count"].sum() == len(values)
        assert found["max"].max() == np.float32(PEAK_MM)
        assert found["min"].min() == np.float32(values.min())
        mean = np.average(found["mean"].astype(float), weights=found["count"])
        assert mean == pytest.approx(values.mean(), abs=1e-5)


def test_a_peak_of_one_row_is_in_the_bucket_of_its_time(made: Path) -> None:
    with page(made) as browser:
        for buckets in (1, 7, 100, 599, 8000):
            for days in (0, 400, 3650):
                since = START - timedelta(days=days)
                answer = browser.series(since, UNTIL, buckets, Y)
                found = answer["series"][Y]
                highest = found.get("max", found.get("value"))
                place = int(np.nanargmax(np.array(highest, dtype=float)))
                assert highest[place] == PEAK_MM
                late_s = slot(PEAK).timestamp() - answer["t"][place]
                assert 0 <= late_s <= max(answer["span_s"] - 1, 0)
                assert len(answer["t"]) <= max(buckets, 1) + 2


def test_few_rows_are_given_one_by_one_with_their_flags(made: Path) -> None:
    names = f"{Y},sigma_y_mm.main,temperature_main_c,reading_air,x_mm.nobody"
    with page(made) as browser:
        answer = browser.series(slot(298), slot(302), 10, names)
    assert answer["span_s"] == 0
    assert answer["t"] == [int(slot(number).timestamp()) for number in range(298, 302)]
    assert answer["flags"] == [1, 1, 4, 4]
    values = {name: found["value"] for name, found in answer["series"].items()}
    assert values[Y] == [pytest.approx(y_mm(298)), pytest.approx(y_mm(299)), None, None]
    assert values["sigma_y_mm.main"] == [pytest.approx(0.2), pytest.approx(0.2), None, None]
    assert values["reading_air"] == [pytest.approx(number / 10) for number in range(298, 302)]
    assert values["x_mm.nobody"] == [None] * 4


@pytest.mark.parametrize("resolution_s", [1, 400, 5000])
def test_flags_and_gaps_are_told_as_spans(made: Path, resolution_s: int) -> None:
    ends = f"since={START.isoformat()}&until={slot(ROWS + 100).isoformat()}".replace("+", "%2B")
    with page(made) as browser:
        answer = browser(f"/api/spans?{ends}&resolution={resolution_s}").json
    (run,) = answer["flags"]
    assert (run["flag"], run["reasons"]) == (4, ["too_dark"])
    first_s, last_s = (slot(number).timestamp() for number in (DARK[0], DARK[-1]))
    assert first_s - run["start"] <= 8 * 8 * PERIOD_S
    assert run["start"] <= first_s
    assert run["end"] >= last_s
    gaps = [(gap["cause"], gap["slots"]) for gap in answer["gaps"]]
    assert gaps == ([("power_loss", 10)] if resolution_s < 2400 else [])


def test_late_rows_are_taken_in(follower: Follower, state: Path) -> None:
    with open_store(state) as store:
        store.add_measurement(row(PEAK, START - timedelta(days=5)))
    follower.look()
    peaks = held(follower, 4)
    assert peaks["count"].sum() == ROWS - len(DARK) + 1


def test_a_row_that_was_moved_leaves_its_old_place(follower: Follower, state: Path) -> None:
    other = START - timedelta(days=3)
    with open_store(state) as store:
        from dataclasses import replace

        moved = replace(row(PEAK, other), redated_from_utc=slot(PEAK))
        store.move_row(slot(PEAK), moved)
    follower.look()
    day = int((other.timestamp() - EPOCH_S) // 86_400)
    a_day = 86_400 // follower.pyramid.lowest_s
    before = follower.pyramid.read(0, Y, day * a_day, a_day)
    after = follower.pyramid.read(0, Y, (day + 3) * a_day, a_day)
    assert before["max"].max() == PEAK_MM
    assert after["max"].max() < 3


def test_a_new_datum_moves_what_is_shown(tmp_path: Path) -> None:
    from dataclasses import replace

    with open_store(tmp_path / "state") as store:
        number = store.add_calibration(calibration(), activate=True)
        store.add_measurement(replace(row(0), calibration_id=number))
        follower = Follower(tmp_path / "state", tmp_path / "cache", PERIOD_S)
        follower.look()
        assert held(follower, 2)["max"] == [0.0]
        store.add_datums({number: datum(0.0, 7.0, 1.5)})
    follower.look()
    assert held(follower, 2)["max"] == [7.0]
    assert held(follower, 0, "sigma_y_mm.main")["max"] == pytest.approx(np.hypot(0.2, 1.5))


def test_the_cache_may_be_removed_and_the_record_replaced(
    follower: Follower, state: Path, tmp_path: Path
) -> None:
    follower.pyramid.clear()
    again = Follower(state, tmp_path / "other", PERIOD_S)
    again.look()
    assert held(again, 3)["max"].max() == PEAK_MM
    shutil.rmtree(state)
    with open_store(state) as store:
        store.add_measurement(row(0))
    again.look()
    assert held(again, 3)["count"].tolist() == [1]


def test_a_second_page_reads_what_the_first_one_makes(
    follower: Follower, state: Path, tmp_path: Path
) -> None:
    second = Follower(state, tmp_path / "cache", PERIOD_S)
    second.look()
    assert second.progress().complete
    assert held(second, 1)["max"].max() == PEAK_MM


def test_looking_changes_nothing_in_the_record(follower: Follower, state: Path) -> None:
    before = (state / "dcam.db").read_bytes()
    follower.look()
    assert (state / "dcam.db").read_bytes() == before
    with open_store(state) as store:  # whoever writes finds nobody in the way of the log's emptying
        store.add_event(START, "started")
        follower.look()
    assert not (state / "dcam.db-wal").exists()
    with open_store_readonly(state) as store:
        assert [event.kind for event in store.events()] == ["started"]


def test_a_day_says_which_share_of_its_slots_has_a_row_and_a_good_one(
    state: Path, tmp_path: Path
) -> None:
    with page(tmp_path) as browser:
        (day,) = browser(f"/api/days?since={START:%Y-%m-%d}&until={UNTIL:%Y-%m-%dT%H:%M:%SZ}").json[
            "days"
        ]
    slots = ROWS + 10  # a gap is at the end
    assert day["completeness"] == pytest.approx(ROWS / slots)
    assert day["good"] == pytest.approx((ROWS - len(DARK)) / slots)


LEFT_OUT = range(PEAK - 3, PEAK + 70)
"""Neither begins nor ends with a bucket."""


@pytest.fixture(scope="module")
def excluding(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record with its peak excluded, and more than that of another point alone."""
    directory = tmp_path_factory.mktemp("excluding")
    shutil.copytree(made / "state", directory / "state")
    span = slot(LEFT_OUT.start), slot(LEFT_OUT.stop)
    with open_store(directory / "state") as store:
        for point, ends in ((None, span), ("quarter", (START, UNTIL))):
            entry = LedgerEntry(LedgerKind.EXCLUDE, "Eve", UNTIL, "painted", *ends, point=point)
            store.add_ledger_entry(entry)
    return directory


@pytest.mark.parametrize("buckets", [2, 7, 61, 199, 2000])
def test_what_the_ledger_excludes_is_left_out_of_the_figures_if_wanted(
    excluding: Path, buckets: int
) -> None:
    """Drawn row by row, in pieces of rows, or of the pyramid at any level."""
    wanted = [y_mm(n) for n in range(ROWS) if n not in DARK and n not in LEFT_OUT]
    names = f"{Y},sigma_y_mm.main,temperature_main_c"
    with page(excluding) as site:
        found = site.series(SINCE, UNTIL, buckets, f"{names}&without_excluded=1")["series"]
        whole = site.series(SINCE, UNTIL, buckets, f"{names}&without_excluded=0")["series"]
    if "value" in found[Y]:
        there = [value for value in found[Y]["value"] if value is not None]
        assert there == pytest.approx(wanted, abs=1e-5)
        assert found["sigma_y_mm.main"]["value"].count(None) == len(LEFT_OUT) + len(DARK)
    else:
        counts = found[Y]["count"]
        assert (sum(counts), sum(found["sigma_y_mm.main"]["count"])) == (len(wanted), len(wanted))
        assert max(value for value in found[Y]["max"] if value is not None) < 2.001
        means = [mean for mean in found[Y]["mean"] if mean is not None]
        mean = np.average(means, weights=[count for count in counts if count])
        assert mean == pytest.approx(np.mean(wanted), abs=1e-4)
    assert found["temperature_main_c"] == whole["temperature_main_c"]
    assert whole[Y] != found[Y]


def test_an_exclusion_that_is_taken_back_is_shown_again(excluding: Path, tmp_path: Path) -> None:
    shutil.copytree(excluding / "state", tmp_path / "state")
    names = f"{Y}&without_excluded=1"
    with page(tmp_path) as site:
        assert max(filter(None, site.series(SINCE, UNTIL, 2000, names)["series"][Y]["value"])) < 2.1
        with open_store(tmp_path / "state") as store:
            undo = LedgerEntry(LedgerKind.UNDO, "Eve", UNTIL, "was dry", entry_id=1)
            store.add_ledger_entry(undo)
        found = site.series(SINCE, UNTIL, 2000, names)["series"][Y]["value"]
    assert max(filter(None, found)) == PEAK_MM
