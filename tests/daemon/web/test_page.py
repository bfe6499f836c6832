"""The page as its user has it: in a browser, by mouse, keyboard, fingers and screen reader."""

from __future__ import annotations

import io
import os
import re
import sqlite3
import threading
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, Route, expect

from benchmarks.page_record import FIRST, GAP_SLOTS, MINUTE, PEAK_MM, SUSPECT
from daemon.store.database import open_store
from daemon.times import slot_text
from daemon.web.follower import Follower
from tests.daemon.web.browsing import Visit, visiting
from tests.daemon.web.conftest import Served
from tests.daemon.web.site import START, page, row
from tests.waiting import PATIENCE_S

PAGES = ("/", "/days", "/analysis", "/events", "/calibrations", "/calibrations/1", "/aim")
WIDE = {"viewport": {"width": 1280, "height": 900}, "color_scheme": "light"}
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "color_scheme": "dark",
    "has_touch": True,
    "is_mobile": True,
}
LARGEST_PICTURE_KB = 150

LINE_PLACES = """
panel => {
  const canvas = panel.querySelector("canvas"), over = panel.querySelector(".over");
  const [a, b] = [canvas.getBoundingClientRect(), over.getBoundingClientRect()];
  const wanted = getComputedStyle(document.documentElement).getPropertyValue("--line-0").trim();
  const rgb = [1, 3, 5].map(k => parseInt(wanted.slice(k, k + 2), 16));
  const scale = canvas.width / a.width;
  const [width, height] = [Math.round(b.width * scale), Math.round(b.height * scale)];
  const { data } = canvas.getContext("2d").getImageData(
    Math.round((b.left - a.left) * scale), Math.round((b.top - a.top) * scale), width, height);
  const places = [];
  for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
    const at = 4 * (y * width + x);
    if (rgb.every((value, k) => Math.abs(data[at + k] - value) < 60) && data[at + 3] > 120)
      places.push([x / scale, y / scale]);
  }
  return places;
}
"""
"""Where the first line of a figure was drawn: px from the top left of its axes, from the top."""


MARKS_OF_MANY_RUNS = """
async pauseS => {
  const { together } = await import("/static/spans.js");
  const spans = Array.from({ length: 1000 }, (_, k) => ({
    lane: "flag", kind: `flag-${3 + k % 2}`, start: 1000 * k + pauseS * Math.floor(k / 20),
    end: 1000 * k + pauseS * Math.floor(k / 20) + 600,
    text: k % 2 ? "bad: too_dark" : "suspect: hidden" }));
  return together(spans, "flag", 0, 1e7, 9);
}
"""
"""A suspect run and a bad one by turns, as clouds and a low sun make them: 20, then a pause."""


BUILDING = "async () => (await (await fetch('/api/site')).json()).building"
"""The share of the record that the page has; None: all of it."""


@pytest.fixture
def visit(browser: Browser, served: Served) -> Iterator[Visit]:
    with visiting(browser, served.url, has_touch=True, **WIDE) as visit:
        yield visit
        assert visit.complaints == []


def around(moment: datetime, minutes: int) -> tuple[str, str]:
    """So many minutes to each side."""
    half = minutes * MINUTE
    return slot_text(moment - half), slot_text(moment + half)


def seconds(span: tuple[str, str]) -> float:
    since, until = (datetime.fromisoformat(text) for text in span)
    return (until - since).total_seconds()


def whole(served: Served) -> tuple[str, str]:
    return slot_text(FIRST), slot_text(served.record.last + MINUTE)


class TestEveryPage:
    @pytest.mark.parametrize("device", [WIDE, PHONE], ids=["wide-light", "phone-dark"])
    def test_nothing_grave_for_axe_nothing_on_the_console_no_request_elsewhere(
        self, browser: Browser, served: Served, device: dict[str, object]
    ) -> None:
        found = []
        with visiting(browser, served.url, **device) as visit:
            for path in (*PAGES, f"/slot/{slot_text(served.record.last)}"):
                visit.go(path)
                found += [f"{path}: {text}" for text in visit.violations()]
                width = visit.page.evaluate("document.documentElement.scrollWidth")
                assert width <= device["viewport"]["width"], f"{path} is wider than the screen"
                expect(visit.page.locator("[data-state=failed]")).to_have_count(0)
        assert found == []
        assert visit.complaints == []

    def test_times_follow_the_choice_of_zone_and_it_is_remembered(self, visit: Visit) -> None:
        visit.go("/events")
        time = visit.page.locator("#gaps tr", has_text="show").last.locator("time").first
        visit.page.locator("#zone").select_option("utc")
        expect(time).to_have_text(re.compile("2026-03-04 11:20"))
        visit.page.locator("#zone").select_option("site")
        expect(time).to_have_text(re.compile("2026-03-04 12:20"))
        visit.go("/calibrations")
        expect(visit.page.locator("#zone")).to_have_value("site")


class TestOverview:
    def test_it_says_how_it_is_doing_and_the_last_value_with_its_sigma(
        self, visit: Visit, served: Served
    ) -> None:
        visit.show(*whole(served))
        state = visit.page.locator("#state")
        expect(state.locator(".verdict")).not_to_be_empty()
        expect(state.get_by_text("±").first).to_be_visible()

    def test_panels_are_chosen_and_remembered(self, visit: Visit, served: Served) -> None:
        visit.show(*whole(served))
        visit.page.get_by_role("checkbox", name="Rig rotation").check()
        visit.settle()
        expect(visit.panel("rotation").locator(".plot")).to_have_attribute(
            "aria-label", re.compile(r"rx from [−\d]")
        )
        visit.show(*whole(served))
        expect(visit.panel("rotation")).to_be_visible()

    @pytest.mark.parametrize("path", ["/", "/days"])
    def test_it_says_how_far_the_record_is_read_until_all_is(
        self, browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str
    ) -> None:
        """Of three days one is read; the others wait."""
        go_on, read = threading.Event(), Follower._build_next

        def held(follower: Follower, connection: sqlite3.Connection) -> None:
            if follower.progress().changes:
                go_on.wait(PATIENCE_S)
            read(follower, connection)

        monkeypatch.setattr(Follower, "_build_next", held)
        with open_store(tmp_path / "state") as store:
            for day in range(3):
                store.add_measurement(row(day, START + timedelta(days=day)))
        with page(tmp_path) as site, visiting(browser, f"http://localhost:{site.port}") as visit:
            visit.page.goto(visit.url + path)
            building = visit.page.locator("#building")
            expect(building).to_contain_text("33 % so far")
            go_on.set()
            expect(building).to_be_hidden()
            visit.settle()
            assert visit.complaints == []


class TestFigure:
    def test_a_peak_of_one_row_is_drawn_and_a_click_on_it_opens_its_slot(
        self, visit: Visit, served: Served
    ) -> None:
        visit.show(*whole(served))
        panel = visit.panel("y")
        expect(panel.locator(".plot")).to_have_attribute(
            "aria-label", re.compile(f"to {PEAK_MM:.3f} mm")
        )
        over = panel.locator(".over")
        places = panel.evaluate(LINE_PLACES)
        x, y = places[0]
        height = over.bounding_box()["height"]
        assert y < 0.1 * height  # nothing but the peak comes near it
        assert min(y for _, y in places if y > 0.3 * height)
        over.click(position={"x": x, "y": y + 2})
        expect(visit.page.locator("dialog section")).to_have_attribute(
            "data-slot", slot_text(served.record.peak)
        )
        visit.settle()
        expect(visit.page.locator("dialog")).to_contain_text("9.000")

    def test_the_wheel_and_a_drag_zoom_and_shift_pans(self, visit: Visit, served: Served) -> None:
        visit.show(*whole(served))
        over = visit.panel("y").locator(".over")
        over.scroll_into_view_if_needed()
        box = over.bounding_box()
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        mouse, first = visit.page.mouse, visit.span()

        mouse.move(*middle)
        mouse.wheel(0, -250)
        second = visit.moved(first)
        assert seconds(second) < 0.7 * seconds(first)

        mouse.move(middle[0] - box["width"] / 4, middle[1])
        mouse.down()
        mouse.move(middle[0], middle[1], steps=3)
        mouse.up()
        third = visit.moved(second)
        assert seconds(third) == pytest.approx(seconds(second) / 4, rel=0.02)

        visit.page.keyboard.down("Shift")
        mouse.move(middle[0] - 100, middle[1])
        mouse.down()
        mouse.move(*middle, steps=3)
        mouse.up()
        visit.page.keyboard.up("Shift")
        fourth = visit.moved(third)
        assert seconds(fourth) == pytest.approx(seconds(third), abs=2)
        assert fourth < third

    def test_two_fingers_zoom_and_one_pans(self, visit: Visit, served: Served) -> None:
        visit.show(*whole(served))
        over = visit.panel("y").locator(".over")
        over.scroll_into_view_if_needed()
        box = over.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        devtools = visit.context.new_cdp_session(visit.page)

        def touch(kind: str, *places: float) -> None:
            points = [{"x": place, "y": y, "id": number} for number, place in enumerate(places)]
            devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        first = visit.span()
        touch("touchStart", x - 50, x + 50)
        for further in (20, 60, 100):
            touch("touchMove", x - 50 - further, x + 50 + further)
        touch("touchEnd")
        second = visit.moved(first)
        assert seconds(second) == pytest.approx(seconds(first) / 3, rel=0.05)

        touch("touchStart", x)
        for further in (20, 60, 100):
            touch("touchMove", x + further)
        touch("touchEnd")
        third = visit.moved(second)
        assert seconds(third) == pytest.approx(seconds(second), abs=2)
        assert third < second

    def test_keys_move_zoom_and_step_from_point_to_point_to_its_images(
        self, visit: Visit, served: Served
    ) -> None:
        visit.show(*around(served.record.last, 30))
        figures = visit.page.locator(".panels")
        figures.focus()
        first = visit.span()
        figures.press("-")
        second = visit.moved(first)
        assert seconds(second) == pytest.approx(2 * seconds(first), abs=2)
        figures.press("ArrowLeft")
        third = visit.moved(second)
        assert third < second
        figures.press("ArrowRight")
        visit.moved(third)
        figures.press(",")  # from the right end: the last row
        said = visit.page.locator("#figure [aria-live]")
        expect(said).to_have_text(re.compile(r"corrected .* ± "))
        figures.press("Enter")
        view = visit.page.locator("dialog section")
        expect(view).to_have_attribute("data-slot", slot_text(served.record.last))
        visit.page.keyboard.press("Escape")
        expect(visit.page.locator("dialog")).to_be_hidden()
        figures.press("0")
        assert seconds(visit.moved(third)) == pytest.approx(seconds(whole(served)), abs=61)

    def test_a_minute_and_ten_years_can_be_shown(self, visit: Visit, served: Served) -> None:
        last = served.record.last
        for span in (timedelta(minutes=1), timedelta(days=3653)):
            visit.show(slot_text(last - span), slot_text(last))
            assert seconds(visit.span()) == pytest.approx(span.total_seconds(), abs=2)

    def test_days_are_typed_in_as_the_site_has_them(self, visit: Visit, served: Served) -> None:
        visit.show(*whole(served))
        first = visit.span()
        visit.page.get_by_label("From", exact=True).fill("2026-03-05")
        visit.page.get_by_label("to", exact=True).fill("2026-03-05")
        visit.page.get_by_role("button", name="Go").click()
        assert visit.moved(first) == ("2026-03-04T23:00:00Z", "2026-03-05T23:00:00Z")

    def test_gaps_flags_and_exclusions_say_their_reason_on_focus(
        self, visit: Visit, served: Served
    ) -> None:
        visit.show(*around(served.record.gap, 200))
        readout = visit.page.locator(".readout")
        gap = visit.page.locator(".mark-gap")
        expect(gap).to_have_accessible_name(re.compile(f"power_loss, {GAP_SLOTS} slots"))
        gap.focus()
        expect(readout).to_contain_text("power_loss")
        visit.show(*around(served.record.suspect, 60))
        visit.page.locator(".mark-flag-3").focus()
        expect(readout).to_contain_text(f"suspect: {SUSPECT.value}")
        visit.page.locator(".mark-excluded").focus()
        expect(readout).to_contain_text("exclude: plate painted (Eve)")

    def test_a_reference_is_laid_over_the_values(self, visit: Visit) -> None:
        visit.go("/")
        expect(visit.panel("y").locator("figcaption")).to_contain_text("levelling.csv")
        visit.page.get_by_role("button", name="all", exact=True).click()
        plot = visit.panel("y").locator(".plot")
        expect(plot).to_have_attribute("aria-label", re.compile("3 values of the reference"))
        assert visit.panel("y").evaluate(LINE_PLACES.replace("--line-0", "--ink"))
        assert "levelling.csv" not in visit.panel("temperature").inner_text()

    def test_hundreds_of_runs_of_two_flags_are_few_marks_that_say_both(self, visit: Visit) -> None:
        visit.go("/events")
        evenly = visit.page.evaluate(MARKS_OF_MANY_RUNS, 0)
        assert 20 < len(evenly) <= 60  # not one mark over all of it
        marks = visit.page.evaluate(MARKS_OF_MANY_RUNS, 50_000)
        assert len(marks) == 50
        assert sum(mark["count"] for mark in marks) == 1000
        assert {mark["kind"] for mark in marks} == {"flag-4"}
        assert all("suspect" in mark["text"] and "bad" in mark["text"] for mark in marks)

    def test_the_line_is_broken_in_a_gap(self, visit: Visit, served: Served) -> None:
        """Half the figure is a gap: nothing is drawn there but its shade."""
        visit.show(*around(served.record.gap, GAP_SLOTS))
        box = visit.panel("y").locator(".over").bounding_box()
        shares = [x / box["width"] for x, _ in visit.panel("y").evaluate(LINE_PLACES)]
        assert min(shares) < 0.1
        assert [share for share in shares if 0.52 < share < 0.98] == []

    def test_the_table_behind_a_figure_has_its_numbers(self, visit: Visit, served: Served) -> None:
        visit.show(*around(served.record.last, 10))
        panel = visit.panel("y")
        panel.locator("summary").click()
        rows = panel.get_by_role("row")
        expect(rows).to_have_count(1 + 11)
        expect(rows.last).to_contain_text(re.compile(r"\d\.\d{3}"))


class TestSlot:
    def test_both_frames_are_shown_with_the_targets_that_are_found_in_them(
        self, visit: Visit, served: Served
    ) -> None:
        visit.go(f"/slot/{slot_text(served.record.last)}")
        for role, at_least in (("main", 5), ("sub", 100)):
            frame = visit.page.locator(f"[data-frame={role}][data-image=ready]")
            expect(frame).to_have_attribute("data-targets", "found")
            assert frame.locator("svg .found").count() >= at_least
        before = visit.page.locator("[data-frame=main] svg").get_attribute("viewBox")
        visit.page.locator("[data-frame=main] button").click()
        expect(visit.page.locator("[data-frame=main] svg")).not_to_have_attribute("viewBox", before)

    def test_previous_and_next_go_from_row_to_row(self, visit: Visit, served: Served) -> None:
        visit.go(f"/slot/{slot_text(served.record.last)}")
        slot = visit.page.locator("#slot")
        expect(slot.locator("[data-go=next]")).to_be_disabled()
        slot.locator("[data-go=previous]").click()
        expect(slot).to_have_attribute("data-slot", slot_text(served.record.last - MINUTE))
        visit.settle()
        visit.page.keyboard.press("ArrowRight")
        expect(slot).to_have_attribute("data-slot", slot_text(served.record.last))
        visit.settle()


class TestOtherPages:
    def test_days_are_a_filmstrip_that_leads_into_the_record(self, visit: Visit) -> None:
        visit.go("/days")
        day = visit.page.locator(".day", has_text="2026-03-06")
        expect(day.locator("img")).to_be_visible()
        day.get_by_role("link").click()
        assert visit.span() == ("2026-03-06T00:00:00Z", "2026-03-07T00:00:00Z")

    def test_the_analysis_has_days_sentences_and_the_reference(
        self, visit: Visit, served: Served
    ) -> None:
        visit.go("/analysis")
        day = f"{served.record.peak:%Y-%m-%d}"
        days = visit.page.get_by_role("group", name="Days").get_by_role("row", name=day)
        expect(days).to_contain_text(f"{PEAK_MM:.3f}")
        expect(visit.page.locator("#analysis")).to_contain_text("mm/year (95 %)")
        comparison = visit.page.locator("#comparison")
        expect(comparison).to_contain_text("levelling.csv")
        expect(comparison).to_contain_text("the two do NOT agree")
        visit.page.get_by_label("Direction").select_option("x")
        visit.page.get_by_role("button", name="Go").click()
        expect(days).not_to_contain_text(f"{PEAK_MM:.3f}")

    def test_both_masses_of_a_reading_have_a_name_of_their_own(self, visit: Visit) -> None:
        """The answer is the server's, but for what a record of months would have found."""
        between = {"value": 1.0, "low": 0.9, "high": 1.1}
        mass = {"name": "deck", "unit": "degC", "kind": "first-order"}
        mass |= {"lag_h": between, "mm_per_unit": between}

        def with_masses(route: Route) -> None:
            found = route.fetch()
            readings = [{**mass, "slow": slow} for slow in (False, True)]
            temperature = {"explained": 0.9, "left_mm": 0.1, "readings": readings}
            route.fulfill(response=found, json={**found.json(), "temperature": temperature})

        visit.page.route("**/api/analysis*", with_masses)
        visit.go("/analysis")
        rows = visit.page.get_by_role("group", name="Temperature").locator("tbody th")
        expect(rows).to_have_text(["deck", "deck, slow part"])

    def test_gaps_and_events_are_tables_and_a_calibration_is_its_report(self, visit: Visit) -> None:
        visit.go("/events")
        expect(visit.page.locator("#gaps table")).to_contain_text("power_loss")
        expect(visit.page.locator("#events table")).to_contain_text("power_lost")
        expect(visit.page.locator("#ledger table")).to_contain_text("plate painted")
        expect(visit.page.locator("#alarms table")).to_contain_text("last-good-value")
        visit.go("/calibrations")
        visit.page.locator("#calibrations").get_by_role("link").first.click()
        visit.settle()
        expect(visit.page.locator("#calibration")).to_contain_text("Passed: held-out positions")

    def test_aiming_shows_focus_histogram_and_room(self, visit: Visit) -> None:
        visit.go("/aim")
        camera = visit.page.locator("[data-camera=main]")
        expect(camera.get_by_text("best so far")).to_be_visible()
        expect(camera.get_by_role("img", name=re.compile("Histogram"))).to_be_visible()
        expect(camera).to_contain_text(re.compile(r"left \d+, right \d+, top \d+, bottom \d+ px"))


class TestPictures:
    @pytest.mark.parametrize("name", ["record", "slot", "phone"])
    def test_the_pictures_of_the_documents(
        self, browser: Browser, served: Served, tmp_path: Path, name: str
    ) -> None:
        """`make page-pictures` has them put into docs/images; they must not make it heavy."""
        directory = Path(os.environ.get("DCAM_PICTURES", tmp_path))
        size = {"width": 1000, "height": 640}
        device = PHONE if name == "phone" else {**WIDE, "viewport": size}
        with visiting(browser, served.url, **device) as visit:
            if name == "record":
                visit.go("/")
                while visit.page.evaluate(BUILDING) is not None:  # the oldest days come last
                    visit.page.wait_for_timeout(200)
            visit.show(*whole(served))
            if name == "record":
                expect(visit.panel("y").locator("figcaption")).to_contain_text("levelling.csv")
                visit.page.locator("#figure").scroll_into_view_if_needed()
                visit.page.evaluate("document.getElementById('figure').scrollIntoView()")
            if name == "slot":
                visit.go(f"/slot/{slot_text(served.record.last)}")
                for role in ("main", "sub"):
                    frame = visit.page.locator(f"[data-frame={role}][data-image=ready]")
                    expect(frame).to_have_attribute("data-targets", "found")
            picture = directory / f"page-{name}.png"
            shot = visit.page.screenshot(animations="disabled", scale="css")
        Image.open(io.BytesIO(shot)).convert("RGB").quantize(64).save(picture, optimize=True)
        assert picture.stat().st_size < 1000 * LARGEST_PICTURE_KB
