"""The pages as their user has them, in a browser, and the pictures of the documents."""

from __future__ import annotations

import io
import os
import re
import sqlite3
import threading
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Route, expect

from benchmarks.page_record import MINUTE, PEAK_MM
from daemon.preview.snapshot import DETAIL_PX
from daemon.store.database import open_store
from daemon.times import slot_text
from daemon.web.follower import Follower
from tests.daemon.web.browsing import PHONE, WIDE, Visit, seconds, visiting
from tests.daemon.web.conftest import Served, whole
from tests.daemon.web.site import START, page, row
from tests.waiting import PATIENCE_S

PAGES = ("/", "/days", "/analysis", "/events", "/calibrations", "/calibrations/1", "/aim")
LARGEST_PICTURE_KB = 150


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
            "aria-label", re.compile(r"about x from [−\d]")
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
        with page(tmp_path) as site, visiting(browser, site.url, **WIDE) as visit:
            visit.page.goto(visit.url + path)
            building = visit.page.locator("#building")
            expect(building).to_contain_text("33 % so far")
            go_on.set()
            expect(building).to_be_hidden()
            visit.settle()
            assert visit.complaints == []

    def test_a_young_record_fills_the_figures(self, browser: Browser, tmp_path: Path) -> None:
        with open_store(tmp_path / "state") as store:
            for minute in range(30):
                store.add_measurement(row(minute))
        with page(tmp_path) as site, visiting(browser, site.url, **WIDE) as visit:
            visit.go("/")
            assert seconds(visit.span()) == 30 * 60


def sideways(visit: Visit, tables: str) -> list[int]:
    """By how much each of these tables is wider than what is seen of it, px."""
    found: list[int] = visit.page.locator(tables).evaluate_all(
        "nodes => nodes.map(node => node.scrollWidth - node.clientWidth)"
    )
    return found


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

    def test_it_says_what_the_ledger_excludes(self, visit: Visit, served: Served) -> None:
        visit.go(f"/slot/{slot_text(served.record.suspect)}")
        notice = visit.page.locator("#slot .notice")
        expect(notice).to_have_text("Excluded by the ledger: plate painted (Eve)")
        visit.go(f"/slot/{slot_text(served.record.suspect - MINUTE)}")
        expect(notice).to_have_count(0)

    def test_a_slot_in_a_gap_says_why_and_claims_no_frame(
        self, visit: Visit, served: Served
    ) -> None:
        visit.go(f"/slot/{slot_text(served.record.gap)}")
        slot = visit.page.locator("#slot")
        expect(slot).to_contain_text("power loss: mains")
        expect(slot.locator("[data-frame=main]")).to_contain_text("nothing was measured")

    def test_its_numbers_fit_on_a_phone(self, browser: Browser, served: Served) -> None:
        with visiting(browser, served.url, **PHONE) as visit:
            visit.go(f"/slot/{slot_text(served.record.last)}")
            assert set(sideways(visit, "#slot .scroll")) == {0}

    def test_a_zoom_to_the_target_moves_nothing_below_it(
        self, visit: Visit, served: Served
    ) -> None:
        visit.go(f"/slot/{slot_text(served.record.last)}")
        frame = visit.page.locator("[data-frame=main][data-targets=found]")
        before = frame.bounding_box()["height"]
        frame.get_by_role("button", name="Zoom to the target").click()
        expect(frame.get_by_role("button", name="Show the whole image")).to_be_visible()
        assert frame.bounding_box()["height"] == pytest.approx(before, abs=1)

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
    def test_days_are_a_filmstrip_that_leads_into_the_record(
        self, visit: Visit, served: Served
    ) -> None:
        visit.go("/days")
        day = visit.page.locator(".day", has_text="2026-03-06")
        expect(day.locator("img")).to_be_visible()
        expect(day).not_to_contain_text("excluded")
        painted = visit.page.locator(".day", has_text=f"{served.record.suspect:%Y-%m-%d}")
        expect(painted).to_contain_text("2.1 % excluded")
        day.get_by_role("link").click()
        assert visit.span() == ("2026-03-06T00:00:00Z", "2026-03-07T00:00:00Z")

    @pytest.mark.parametrize("path", ["/events", "/calibrations"])
    def test_long_tables_are_read_on_a_phone_without_moving_sideways(
        self, browser: Browser, served: Served, path: str
    ) -> None:
        with visiting(browser, served.url, **PHONE) as visit:
            visit.go(path)
            found = sideways(visit, ".scroll:visible")
            assert set(found) == {0}
            assert visit.page.locator(".scroll td:visible").first.evaluate(
                "cell => getComputedStyle(cell, '::before').content.length > 4"
            )  # the name of its column

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

    def test_times_in_the_sentences_of_the_analysis_follow_the_zone(self, visit: Visit) -> None:
        def with_step(route: Route) -> None:
            found = route.fetch()
            line = "step at 2026-03-02T12:00:00Z, +0.300 mm"
            route.fulfill(response=found, json={**found.json(), "sentences": [line]})

        visit.page.route("**/api/analysis*", with_step)
        visit.go("/analysis")
        line = visit.page.locator("#analysis li")
        visit.page.locator("#zone").select_option("utc")
        expect(line).to_have_text("step at 2026-03-02 12:00, +0.300 mm")
        visit.page.locator("#zone").select_option("site")
        expect(line).to_have_text("step at 2026-03-02 13:00, +0.300 mm")

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
        expect(visit.page.locator("#gaps table")).to_contain_text("power loss")
        expect(visit.page.locator("#events table")).to_contain_text("power lost")
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
        pixels = camera.get_by_role("img", name="pixel for pixel")
        expect(pixels).to_have_count(0)
        visit.page.get_by_role("button", name="Show single pixels").click()
        expect(pixels).to_be_visible()
        assert pixels.evaluate("node => node.naturalWidth") > 0

    @pytest.mark.parametrize("width_px", [320, 390, 700, 1000])
    def test_single_pixels_are_never_made_smaller_but_cut_about_the_middle(
        self, visit: Visit, width_px: int
    ) -> None:
        """Where the window is too narrow for all of them; and it need not be scrolled sideways."""
        noise = np.random.default_rng(5).integers(0, 255, (DETAIL_PX, DETAIL_PX), dtype=np.uint8)
        png = cv2.imencode(".png", noise)[1].tobytes()
        visit.page.route(
            "**/aim/*_detail.png*", lambda route: route.fulfill(body=png, content_type="image/png")
        )
        visit.page.set_viewport_size({"width": width_px, "height": 900})
        visit.go("/aim")
        visit.page.get_by_role("button", name="Show single pixels").click()
        for role in ("main", "sub"):
            camera = visit.page.locator(f"[data-camera={role}]")
            pixels = camera.get_by_role("img", name="pixel for pixel")
            expect(pixels).to_have_js_property("naturalWidth", DETAIL_PX)
            shot = np.array(Image.open(io.BytesIO(pixels.screenshot(scale="css"))).convert("L"))
            drawn = shot[2:-2, 2:-2]  # the edge may lie between two pixels of the screen
            height, width = drawn.shape
            assert min(height, width) > 250
            match = cv2.matchTemplate(noise, drawn, cv2.TM_SQDIFF)
            top, left = np.unravel_index(match.argmin(), match.shape)
            assert match.min() < height * width, "not pixel for pixel"
            assert top + height / 2 == pytest.approx(DETAIL_PX / 2, abs=1)
            assert left + width / 2 == pytest.approx(DETAIL_PX / 2, abs=1)
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= width_px


class TestPictures:
    @pytest.mark.parametrize("name", ["record", "slot", "phone"])
    def test_the_pictures_of_the_documents(
        self, browser: Browser, served: Served, tmp_path: Path, name: str
    ) -> None:
        """`make page-pictures` has them put into docs/images; they must not make it heavy."""
        directory = Path(os.environ.get("DCAM_PICTURES", tmp_path))
        with visiting(browser, served.url, **(PHONE if name == "phone" else WIDE)) as visit:
            if name != "phone":
                visit.page.set_viewport_size({"width": 1000, "height": 640})
            if name == "record":
                visit.go("/")
            if name != "slot":
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
        colours = 64 if name == "slot" else 256  # fewer would give lines of figures other colours
        Image.open(io.BytesIO(shot)).convert("RGB").quantize(colours).save(picture, optimize=True)
        assert picture.stat().st_size < 1000 * LARGEST_PICTURE_KB
