"""The figures of the record: by mouse, keyboard, fingers and screen reader."""

from __future__ import annotations

import re
from datetime import timedelta

import pytest
from playwright.sync_api import Route, expect

from benchmarks.page_record import GAP_SLOTS, MINUTE, PEAK_MM, SUSPECT
from daemon.times import slot_text
from tests.daemon.web.browsing import LINE_PLACES, Visit, around, seconds
from tests.daemon.web.conftest import Served, whole

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

ZOOMED = """
async () => {
  const drawn = name => document.querySelector(`[data-panel=${name}] canvas`).toDataURL();
  const names = ["y", "temperature"];
  const before = names.map(drawn);
  const isNew = (name, k) => [name, drawn(name) !== before[k]];
  const changed = () => Object.fromEntries(names.map(isNew));
  const over = document.querySelector("[data-panel=y] .over"), box = over.getBoundingClientRect();
  over.dispatchEvent(new WheelEvent("wheel", { deltaY: -200, cancelable: true,
    clientX: box.left + 0.4 * box.width, clientY: box.top + 20 }));
  await new Promise(requestAnimationFrame);  // behind the page's own, which draws
  const atOnce = changed();
  while (!document.querySelector("#figure[data-settled]")) await new Promise(requestAnimationFrame);
  return [atOnce, changed()];
}
"""
"""Which figures have changed in the first frame after a turn of the wheel, and in the end."""


def test_a_peak_of_one_row_is_drawn_and_a_click_on_it_opens_its_slot(
    visit: Visit, served: Served
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


def test_the_wheel_and_a_drag_zoom_and_shift_pans(visit: Visit, served: Served) -> None:
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


def test_two_fingers_zoom_and_one_pans(visit: Visit, served: Served) -> None:
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
    visit: Visit, served: Served
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
    expect(said).to_have_text(re.compile(r"corrected .*\s±\s"))
    figures.press("Enter")
    view = visit.page.locator("dialog section")
    expect(view).to_have_attribute("data-slot", slot_text(served.record.last))
    visit.page.keyboard.press("Escape")
    expect(visit.page.locator("dialog")).to_be_hidden()
    figures.press("0")
    assert seconds(visit.moved(third)) == pytest.approx(seconds(whole(served)), abs=61)


def test_a_minute_and_ten_years_can_be_shown(visit: Visit, served: Served) -> None:
    last = served.record.last
    for span in (timedelta(minutes=1), timedelta(days=3653)):
        visit.show(slot_text(last - span), slot_text(last))
        assert seconds(visit.span()) == pytest.approx(span.total_seconds(), abs=2)


DRAWN_AGAIN = """() => new Promise((done) => {
  const figure = document.querySelector("#figure");
  new MutationObserver(() => done()).observe(figure, { attributeFilter: ["data-settled"] });
  document.dispatchEvent(new Event("zone"));
})"""


def test_days_are_typed_in_as_the_site_has_them(visit: Visit, served: Served) -> None:
    """Also when the figures are drawn again in the middle of it."""
    visit.show(*whole(served))
    first = visit.span()
    visit.page.get_by_label("From", exact=True).fill("2026-03-05")
    visit.page.evaluate(DRAWN_AGAIN)
    visit.page.get_by_label("to", exact=True).fill("2026-03-05")
    visit.page.get_by_role("button", name="Go").click()
    assert visit.moved(first) == ("2026-03-04T23:00:00Z", "2026-03-05T23:00:00Z")


def test_gaps_flags_and_exclusions_say_their_reason_on_focus(visit: Visit, served: Served) -> None:
    visit.show(*around(served.record.gap, 200))
    readout = visit.page.locator(".readout")
    gap = visit.page.locator(".mark-gap")
    expect(gap).to_have_accessible_name(re.compile(f"power loss, {GAP_SLOTS} slots"))
    gap.focus()
    expect(readout).to_contain_text("power loss")
    visit.show(*around(served.record.suspect, 60))
    visit.page.locator(".mark-flag-3").focus()
    expect(readout).to_contain_text(f"suspect: {SUSPECT.value.replace('_', ' ')}")
    visit.page.locator(".mark-excluded").focus()
    expect(readout).to_contain_text("excluded: plate painted (Eve)")


def test_a_reference_is_laid_over_the_values(visit: Visit) -> None:
    visit.go("/")
    expect(visit.panel("y").locator("figcaption")).to_contain_text("levelling.csv")
    visit.page.get_by_role("button", name="all", exact=True).click()
    plot = visit.panel("y").locator(".plot")
    expect(plot).to_have_attribute("aria-label", re.compile("3 values of the reference"))
    assert visit.panel("y").evaluate(LINE_PLACES.replace("--line-0", "--ink"))
    assert "levelling.csv" not in visit.panel("temperature").inner_text()


def test_hundreds_of_runs_of_two_flags_are_few_marks_that_say_both(visit: Visit) -> None:
    visit.go("/events")
    evenly = visit.page.evaluate(MARKS_OF_MANY_RUNS, 0)
    assert 20 < len(evenly) <= 60  # not one mark over all of it
    marks = visit.page.evaluate(MARKS_OF_MANY_RUNS, 50_000)
    assert len(marks) == 50
    assert sum(mark["count"] for mark in marks) == 1000
    assert {mark["kind"] for mark in marks} == {"flag-4"}
    assert all("suspect" in mark["text"] and "bad" in mark["text"] for mark in marks)


def test_by_keyboard_a_row_of_marks_is_one_stop_on_the_way_to_the_figures(
    visit: Visit, served: Served
) -> None:
    visit.show(*whole(served))
    marks = visit.page.locator("[aria-label=Flags] .mark")
    assert marks.count() > 5
    keyboard, readout = visit.page.keyboard, visit.page.locator(".readout")
    marks.first.focus()
    keyboard.press("ArrowRight")
    expect(marks.nth(1)).to_be_focused()
    expect(readout).to_have_text(marks.nth(1).get_attribute("aria-label") or "")
    keyboard.press("Tab")
    expect(visit.page.locator("[aria-label=Ledger] .mark").first).to_be_focused()
    keyboard.press("Tab")
    expect(visit.page.locator("[aria-label=Events] .mark").first).to_be_focused()
    keyboard.press("Tab")
    expect(visit.page.locator(".panels")).to_be_focused()


def test_what_the_ledger_excludes_is_left_out_if_wanted(visit: Visit, served: Served) -> None:
    """Half an hour of suspect rows: the choice stays in the address, as a link is passed on."""
    visit.show(*around(served.record.suspect, 25))
    plot, choice = visit.panel("y").locator(".plot"), visit.page.get_by_label("Without what")
    assert is_drawn(visit, 0.75)
    choice.check()
    visit.settle()
    assert not is_drawn(visit, 0.75)
    assert is_drawn(visit, 0.25)
    plot.locator(".over").click(position={"x": 900, "y": 60})
    expect(visit.page.locator(".readout")).to_contain_text("excluded: plate painted")
    visit.page.reload()
    visit.settle()
    expect(choice).to_be_checked()
    assert not is_drawn(visit, 0.75)


def is_drawn(visit: Visit, share: float) -> bool:
    """Whether there is a line at this share of the first figure's width."""
    width = visit.panel("y").locator(".over").bounding_box()["width"]
    places = visit.panel("y").evaluate(LINE_PLACES)
    return any(abs(x / width - share) < 0.05 for x, _ in places)


def test_a_row_after_a_gap_is_not_in_it(visit: Visit, served: Served) -> None:
    visit.show(*around(served.record.gap + GAP_SLOTS * MINUTE, 10))
    figures = visit.page.locator(".panels")
    figures.focus()
    figures.press(".")
    said = visit.page.locator("#figure [aria-live]")
    expect(said).to_contain_text("corrected")
    expect(said).not_to_contain_text("gap")


def test_moments_in_a_row_never_look_like_one_that_lasted(visit: Visit) -> None:
    """A restart each hour for ten hours, an hour as wide as a mark."""
    visit.go("/events")
    marks = visit.page.evaluate(
        """async () => {
          const { together } = await import("/static/spans.js");
          const spans = Array.from({ length: 10 }, (_, k) => ({
            lane: "event", kind: "event", start: 3600 * k, end: 3600 * k, text: "started" }));
          return together(spans, "event", 0, 36000, 3601);
        }"""
    )
    assert [mark["end"] - mark["start"] for mark in marks] == [3600] * 5


def test_the_line_is_broken_in_a_gap(visit: Visit, served: Served) -> None:
    """Half the figure is a gap: nothing is drawn there but its shade."""
    visit.show(*around(served.record.gap, GAP_SLOTS))
    box = visit.panel("y").locator(".over").bounding_box()
    shares = [x / box["width"] for x, _ in visit.panel("y").evaluate(LINE_PLACES)]
    assert min(shares) < 0.1
    assert [share for share in shares if 0.52 < share < 0.98] == []


def test_two_lines_that_reach_equally_far_are_both_seen(visit: Visit, served: Served) -> None:
    """Each piece of either reaches from -1 to 1 mrad; their means lie apart."""

    def as_wide(route: Route) -> None:
        found = route.fetch()
        answer = found.json()
        for name, mean in (("rx_rad", -0.5), ("ry_rad", 0.5)):
            for part, value in (("min", -1.0), ("mean", mean), ("max", 1.0)):
                answer["series"].get(name, {})[part] = [value / 1000.0] * len(answer["t"])
        route.fulfill(response=found, json=answer)

    visit.page.route("**/api/series*", as_wide)
    visit.show(*whole(served))
    visit.page.get_by_role("checkbox", name="Rig rotation").check()
    visit.settle()
    panel = visit.panel("rotation")
    panel.locator(".plot").scroll_into_view_if_needed()
    box = panel.locator(".over").bounding_box()
    for hue, place in ((0, 0.75), (1, 0.25)):
        places = panel.evaluate(LINE_PLACES.replace("--line-0", f"--line-{hue}"))
        there = {round(x) for x, y in places if abs(y / box["height"] - place) < 0.1}
        assert len(there) > 0.9 * box["width"], f"line {hue}"


def test_a_move_draws_what_is_in_sight_at_once_and_the_rest_when_it_settles(
    visit: Visit, served: Served
) -> None:
    visit.page.set_viewport_size({"width": 1280, "height": 500})
    visit.show(*whole(served))
    panel = visit.panel("temperature").locator(".over")
    assert panel.bounding_box()["y"] > 700
    at_once, in_the_end = visit.page.evaluate(ZOOMED)
    assert at_once == {"y": True, "temperature": False}
    assert in_the_end == {"y": True, "temperature": True}


def test_the_table_behind_a_figure_has_its_numbers(visit: Visit, served: Served) -> None:
    visit.show(*around(served.record.last, 10))
    panel = visit.panel("y")
    panel.locator("summary").click()
    rows = panel.get_by_role("row")
    expect(rows).to_have_count(1 + 11)
    expect(rows.last).to_contain_text(re.compile(r"\d\.\d{3}"))
