"""`dcam-web` of all sites, in a browser: a list by worst, a map, and each site's record."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from starlette.applications import Starlette

from benchmarks.page_server import serving
from benchmarks.record import fill
from daemon.config.centre import load_centre
from daemon.fleet.sync import Sync
from daemon.store.central.writing import SiteFacts
from daemon.web import site_copy
from daemon.web.fleet_app import FleetPage
from tests.daemon.fleet.conftest import Pier, sync
from tests.daemon.fleet.postgres import Proxy, Server
from tests.daemon.fleet.test_commands import ctl, with_url
from tests.daemon.web.browsing import PHONE, visiting
from tests.laboratory import laboratory
from tests.waiting import wait_for

NAME = "pier one / east"


def test_all_sites_are_a_list_a_map_and_each_its_record(
    server: Server,
    central: str,
    pier: Pier,
    browser: Browser,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    config, state = tmp_path / "dcam.toml", tmp_path / "one"
    text, place = with_url(server.url(central)), "latitude_deg = 50.0\nlongitude_deg = 8.1\n"
    before, after = text.split('name = "')
    config.write_text(f'{before}{place}name = "{NAME}"{after.partition(chr(34))[2]}')
    fill(state, 300)
    assert ctl(capsys, "--config", config, "--state", state, "sync")[0] == 0
    sync(server.url(central), pier("two", 1), "pier-2")  # has not said how it is
    centre = tmp_path / "centre.toml"
    centre.write_text(f'[fleet]\nurl = "{server.url(central)}"\n')
    with (
        serving(centre, None) as url,
        visiting(browser, url) as visit,
    ):
        visit.go("/")
        names = visit.page.locator("#sites tbody th").all_inner_texts()
        assert names == [NAME, "pier-2"]  # no daemon runs at the first
        sums = "measuring: 0; no new rows: 2; not heard from: 0; with alarms: 0 (0 raised)"
        assert visit.page.locator("#sums").inner_text() == sums
        places = [
            tuple(float(mark.get_attribute(axis) or 0) for axis in ("cx", "cy"))
            for mark in visit.page.locator(".map circle").all()
        ]
        assert visit.violations() == []
        assert visit.page.locator("#zone").input_value() == "utc"  # there is no one site's time
        expect(visit.page.locator(".levels")).to_have_text(re.compile("critical.*unknown"))
        with visiting(browser, url, **PHONE) as phone:
            phone.go("/")
            name = phone.page.locator(".map text", has_text=NAME)
            assert name.evaluate("node => node.getBoundingClientRect().height") > 10
            assert phone.page.locator("#sites .scroll").evaluate(
                "node => node.scrollWidth == node.clientWidth"
            )
        # The worst is drawn last. It is 7.2 km further east; the scale says how far that is.
        (west, first_y), (east, second_y) = places
        assert first_y == second_y
        bar = visit.page.locator(".map .scale")
        (start, end) = (bar.locator("path").get_attribute("d") or "").split("H")
        bar_px = float(end.split("V")[0]) - float(start[1:].split(" ")[0])
        said_km = float((bar.locator("text").text_content() or "").split(" ")[0])
        assert (east - west) / bar_px * said_km == pytest.approx(7.155, rel=0.01)

        visit.page.locator("#sites tbody th a", has_text=NAME).click()
        expect(visit.page.locator("#figure[data-settled]")).to_be_attached()
        expect(visit.page.locator("#state")).to_have_attribute("data-level", "2")
        assert "heard" in visit.page.locator("#state").inner_text()
        assert visit.page.locator("nav a", has_text="Aim").count() == 0
        root = visit.page.url.removeprefix(url).partition("#")[0]
        slot = visit.page.request.get(f"{url}{root}api/slot/2026-03-01T01:00:00Z").json()
        here = "2026-03-01T01:00:00Z"
        row = next(
            line for line in ctl(
                capsys, "--config", config, "--state", state, "export"
            )[1].splitlines() if line.startswith(here)
        )  # fmt: skip
        assert slot["points"]["main"]["y_mm"] == pytest.approx(float(row.split(",")[4]), abs=1e-6)
        visit.go(f"{root}slot/{here}")
        expect(visit.page.locator("[data-frame=main]")).to_contain_text("Frames stay at the pier")
        visit.go(f"{root}days")
        expect(visit.page.locator("#days")).to_contain_text("pictures at the pier")
        visit.page.locator("#days a").first.click()
        expect(visit.page.locator("#figure[data-settled]")).to_be_attached()
        assert visit.page.request.get(f"{url}{root}aim").status == 404
        assert visit.page.request.get(f"{url}/sites/nobody/").status == 404

        def other() -> tuple[int, bool]:  # has shared no config
            answer = visit.page.request.get(f"{url}/sites/pier-2/")
            return answer.status, "site: missing" in answer.text()

        wait_for(lambda: other() == (503, True), "what the other site lacks")
        assert visit.complaints == []


def test_a_site_is_as_of_its_last_copy_once_the_centre_is_away(
    server: Server, central: str, pier: Pier, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(site_copy, "REFRESH_S", 0.1)
    facts = SiteFacts("pier-1", 60, None, laboratory(640))
    Sync(server.url(central), None, pier("one", 3), facts).run()
    line = Proxy(server.port, lambda _cuts: None)
    centre = tmp_path / "centre.toml"
    centre.write_text(f'[fleet]\nurl = "{server.url(central, line.port)}"\n')
    page = FleetPage(load_centre(centre))
    scope = {"root_path": "/sites/pier-1", "path": "/sites/pier-1/", "headers": []}
    try:
        wait_for(lambda: isinstance(page._app("pier-1", scope), Starlette), "the copy")
        site = page._open["pier-1"]
        assert site.page is not None
        assert site.page.overviews.fields()["verdict"]["word"] == "unknown"  # it never said
        line.close()
        wait_for(lambda: site.copy.trouble, "a look at the centre")
        wait_for(
            lambda: site.page.overviews.fields()["items"][0]["name"] == "central database",
            "the page to say so",
        )
        assert site.page.record.span() is not None  # what was copied is there
    finally:
        page.close()
