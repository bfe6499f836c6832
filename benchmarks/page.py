"""How long the page of dcam-web takes in a browser, on a record of years.

By itself, with a size and a place to keep the record: `python -m benchmarks.page --help`. Needs
Debian's Chromium.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser, Page, expect, sync_playwright

from benchmarks.page_record import FIRST, MINUTE, write_record
from benchmarks.page_server import serving, wait_until_read
from daemon.config.reading import load_config
from daemon.store.revisions import REVISIONS
from daemon.times import slot_text

CONFIG = Path(__file__).with_name("small.toml")
CHROMIUM = "/usr/bin/chromium"
ROWS = 1_000_000
RUNS = 5
THROTTLED = 4
"""A phone: so many times slower than this computer."""
PATIENCE_MS = 120_000

_WATCH = """
  window.whenReady = (selector, since) => new Promise((done, fail) => {
    const look = () => {
      const failed = document.querySelector("[data-state=failed]");
      if (!failed && !document.querySelector(selector)) return;
      watching.disconnect();
      if (failed) fail(new Error(document.body.innerText));
      else requestAnimationFrame(() => done(performance.now() - since));
    };
    const watching = new MutationObserver(look);
    const noted = { attributes: true, attributeFilter: ["data-state", "data-image"] };
    watching.observe(document, { subtree: true, childList: true, ...noted });
    look();
  });
"""
"""Looking in each frame would take a part of what is measured."""
_READY = "#figure[data-state=ready]"
_FRAMES = "dialog:has([data-frame=main][data-image=ready]):has([data-frame=sub][data-image=ready])"
_WHEEL = """
async up => {
  const over = document.querySelector("[data-panel=y] .over"), box = over.getBoundingClientRect();
  const since = performance.now();
  over.dispatchEvent(new WheelEvent("wheel", { deltaY: up, shiftKey: false, cancelable: true,
    clientX: box.left + 0.4 * box.width, clientY: box.top + 20 }));
  return whenReady("#figure[data-state=ready]", since);
}
"""
_PAN = """
async () => {
  const since = performance.now();
  document.querySelector("[aria-label=Earlier]").click();
  return whenReady("#figure[data-state=ready]", since);
}
"""


@dataclass(frozen=True, slots=True)
class PageCost:
    """Seconds in the browser; of several runs the median, and the worst."""

    rows: int
    throttling: int
    first_figure_s: tuple[float, float]
    """From the address to four drawn figures of the whole record, a browser that knows nothing."""
    zoom_s: tuple[float, float]
    pan_s: tuple[float, float]
    frames_s: tuple[float, float]
    """From a click on a slot's point to both of its frames."""


def measure_page(rows: int = ROWS, state: Path | None = None) -> Iterator[PageCost]:
    """Write a record below `state`, unless it is there; look at it as a computer and as a phone."""
    with tempfile.TemporaryDirectory(prefix="dcam-bench-") as scratch, sync_playwright() as driver:
        # A later version's tables are others: a record of an older one stays beside it.
        directory = (state or Path(scratch)) / f"{rows}-rows-{REVISIONS[-1]}"
        if not (directory / "dcam.db").exists():
            write_record(directory, load_config(CONFIG).site(), rows)
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        with serving(CONFIG, directory) as url:
            wait_until_read(url)
            for throttling in (1, THROTTLED):
                yield _measure(browser, url, rows, throttling)
        browser.close()


def _measure(browser: Browser, url: str, rows: int, throttling: int) -> PageCost:
    last = FIRST + (rows - 1) * MINUTE
    whole = f"{url}/#since={slot_text(FIRST)}&until={slot_text(last + MINUTE)}"
    firsts, zooms, pans, frames = [], [], [], []
    for _ in range(RUNS):
        with _window(browser, throttling) as page:
            page.goto(whole, wait_until="commit")
            firsts.append(page.evaluate(f"whenReady({_READY!r}, 0)"))
            for up in (-700, -700, -700, 500):
                zooms.append(page.evaluate(_WHEEL, up))
                pans.append(page.evaluate(_PAN))
        with _window(browser, throttling) as page:
            page.goto(f"{url}/#since={slot_text(last - 30 * MINUTE)}&until={slot_text(last)}")
            expect(page.locator(_READY)).to_be_attached(timeout=PATIENCE_MS)
            figures = page.locator(".panels")
            figures.press(",")
            page.evaluate("window.pressed = performance.now()")
            figures.press("Enter")
            frames.append(page.evaluate(f"whenReady({_FRAMES!r}, window.pressed)"))
    return PageCost(
        rows, throttling, *(_ends(times_ms) for times_ms in (firsts, zooms, pans, frames))
    )


@contextmanager
def _window(browser: Browser, throttling: int) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, bypass_csp=True)
    context.set_default_timeout(PATIENCE_MS)
    context.add_init_script(_WATCH)
    page = context.new_page()
    devtools = context.new_cdp_session(page)
    devtools.send("Emulation.setCPUThrottlingRate", {"rate": throttling})
    try:
        yield page
    finally:
        context.close()


def _ends(times_ms: list[float]) -> tuple[float, float]:
    return statistics.median(times_ms) / 1000.0, max(times_ms) / 1000.0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument(
        "--state", type=Path, metavar="DIR", help="keep records here, use them again"
    )
    options = parser.parse_args()
    for cost in measure_page(options.rows, options.state):
        print(f"{cost.rows} rows, processor at 1/{cost.throttling}: median and worst")
        for name in ("first_figure_s", "zoom_s", "pan_s", "frames_s"):
            median, worst = getattr(cost, name)
            print(f"  {name:15} {median:6.3f} {worst:6.3f}")


if __name__ == "__main__":
    main()
