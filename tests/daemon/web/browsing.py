"""A real browser, looked through from outside: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from weakref import WeakKeyDictionary

import pytest
from playwright.sync_api import (
    Browser,
    BrowserContext,
    ConsoleMessage,
    Error,
    Locator,
    Page,
    Playwright,
    Request,
    expect,
)

from benchmarks.page_record import MINUTE
from daemon.times import slot_text

CHROMIUM = Path("/usr/bin/chromium")
PATIENCE_MS = 300_000
"""Far longer than anything takes on a busy machine: only a failure takes so long."""
AXE = Path(__file__).parents[3] / "node_modules/axe-core/axe.min.js"
GRAVE = {"serious", "critical"}
WIDE = {"viewport": {"width": 1280, "height": 900}, "color_scheme": "light", "has_touch": True}
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "color_scheme": "dark",
    "has_touch": True,
    "is_mobile": True,
}

LINE_PLACES = """
panel => {
  const canvas = panel.querySelector("canvas"), over = panel.querySelector(".over");
  const [a, b] = [canvas.getBoundingClientRect(), over.getBoundingClientRect()];
  const wanted = getComputedStyle(document.documentElement).getPropertyValue("--line-0").trim();
  const rgb = [1, 3, 5].map(k => parseInt(wanted.slice(k, k + 2), 16));
  const scale = canvas.width / a.width;
  const [width, height] = [Math.round(b.width * scale), Math.round(b.height * scale)];
  const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  const [left, top] = [Math.round((b.left - a.left) * scale), Math.round((b.top - a.top) * scale)];
  copy.drawImage(canvas, -left, -top);
  const { data } = copy.getImageData(0, 0, width, height);
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

expect.set_options(timeout=PATIENCE_MS)


def around(moment: datetime, minutes: int) -> tuple[str, str]:
    """So many minutes to each side."""
    half = minutes * MINUTE
    return slot_text(moment - half), slot_text(moment + half)


def seconds(span: tuple[str, str]) -> float:
    since, until = (datetime.fromisoformat(text) for text in span)
    return (until - since).total_seconds()


def start_chromium(playwright: Playwright) -> Browser:
    """Debian's browser; the test is skipped where there is none.

    As root, as in a container, it runs without a sandbox of its own.
    """
    if not CHROMIUM.exists():
        pytest.skip("Debian's chromium is missing: apt-get install chromium fonts-dejavu-core")
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    return playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)


@dataclass
class Visit:
    """A page of dcam-web, and what it complained about."""

    url: str
    context: BrowserContext
    page: Page
    complaints: list[str] = field(default_factory=list)
    shown: int = 0

    def go(self, path: str) -> None:
        """Open a page and wait until every part of it has its content."""
        self.page.goto(self.url + path)
        self.settle()

    def settle(self) -> None:
        """Wait until nothing on the page is loading."""
        expect(self.page.locator("body [data-state]").first).to_be_attached()
        expect(self.page.locator("[data-state=loading]")).to_have_count(0)
        expect(self.page.locator("#figure:not([data-settled])")).to_have_count(0)

    def show(self, since: str, until: str) -> None:
        """The overview with its figures over a span."""
        self.shown += 1  # the same page with nothing new but its hash would not be loaded again
        self.go(f"/?{self.shown}#since={since}&until={until}")

    def span(self) -> tuple[str, str]:
        """What the figures show, from and to, once they have settled there."""
        self.settle()
        figure = self.page.locator("#figure[data-settled]")
        since, _, until = (figure.get_attribute("data-settled") or "").partition(" ")
        return since, until

    def moved(self, before: tuple[str, str]) -> tuple[str, str]:
        """The span shown after a gesture: waits until it is another one."""
        expect(
            self.page.locator(f"#figure:not([data-settled='{' '.join(before)}'])")
        ).to_be_attached()
        return self.span()

    def panel(self, name: str) -> Locator:
        """A figure."""
        return self.page.locator(f"[data-panel={name}]")

    def violations(self) -> list[str]:
        """What axe-core finds of a serious or critical kind."""
        self.page.evaluate(AXE.read_text(encoding="utf-8"))
        found: list[dict[str, Any]] = self.page.evaluate(
            "axe.run({ resultTypes: ['violations'], iframes: false }).then(all => all.violations)"
        )
        return [
            f"{rule['id']}: {json.dumps([node['target'] for node in rule['nodes']])}"
            for rule in found
            if rule["impact"] in GRAVE
        ]


IDLE = "/static/strings/en.json"
"""A page that does nothing: there a window waits for the next visit."""
_idle: WeakKeyDictionary[Browser, list[tuple[dict[str, Any], Page]]] = WeakKeyDictionary()
"""Windows that no visit uses, with their options: to open one costs as much as to load a page."""


@contextmanager
def visiting(browser: Browser, url: str, **options: Any) -> Iterator[Visit]:
    """A window as if new, whose complaints, failures and requests elsewhere are collected."""
    page = _window(browser, options)
    visit, size = Visit(url, page.context, page), page.viewport_size

    def requested(request: Request) -> None:
        address = request.url
        if urlsplit(address).scheme not in {"data", "blob"} and not address.startswith(url + "/"):
            visit.complaints.append(f"asked elsewhere: {address}")

    def said(message: ConsoleMessage) -> None:
        if message.type in {"error", "warning"}:
            visit.complaints.append(f"{message.type}: {message.text}")

    def failed(error: Error) -> None:
        visit.complaints.append(f"error: {error}")

    page.on("request", requested)
    page.on("console", said)
    page.on("pageerror", failed)
    try:
        yield visit
    except BaseException:
        page.context.close()  # in whatever state it is
        raise
    page.remove_listener("request", requested)
    page.remove_listener("console", said)
    page.remove_listener("pageerror", failed)
    _clear(visit)
    if size is not None:
        page.set_viewport_size(size)
    _idle.setdefault(browser, []).append((options, page))


def _window(browser: Browser, options: dict[str, Any]) -> Page:
    """One that waits, if there is one with these options; else a new one."""
    waiting = _idle.get(browser, [])
    for number, (others, page) in enumerate(waiting):
        if others == options:
            del waiting[number]
            return page
    context = browser.new_context(**options)
    context.set_default_timeout(PATIENCE_MS)
    return context.new_page()


def _clear(visit: Visit) -> None:
    """Have the window forget what it was used for."""
    page, context = visit.page, visit.context
    page.unroute_all(behavior="wait")
    page.mouse.move(0, 0)
    page.goto(visit.url + IDLE)
    page.evaluate("localStorage.clear()")
    context.clear_cookies()
