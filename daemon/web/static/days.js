// The days as a filmstrip.

import { followBuilding } from "./building.js";
import { at, el, epoch, fill, fixed, getJson, iso, percent, svg, t, table } from "./page.js";

const node = document.getElementById("days");
const DAYS = 60;
const DAY_S = 86400;
const [WIDTH, HEIGHT] = [16, 64];

const bar = (day, low, high) => {
  if (day.y_mm?.min === null || day.y_mm?.min === undefined) return null;
  const y = (value) => HEIGHT - (HEIGHT * (value - low)) / (high - low || 1);
  const tall = Math.max(1.5, y(day.y_mm.min) - y(day.y_mm.max));
  return svg("svg", { class: "day-bar", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true" },
    svg("rect", { class: "extent", x: 5, y: y(day.y_mm.max), width: 6, height: tall }),
    svg("rect", { class: "middle", x: 1, y: y(day.y_mm.mean) - 0.75, width: 14, height: 1.5 }));
};

const noPicture = () => el("span", { class: "no-picture" }, t("no_picture"));

const picture = (source) => {
  const image = el("img", { src: source, alt: "", loading: "lazy", onerror: () => image.replaceWith(noPicture()) });
  return image;
};

const card = (day, low, high) => {
  const until = iso(Date.parse(`${day.day}T00:00:00Z`) / 1000 + DAY_S);
  const left = day.excluded > 0;
  return el("li", { class: `day day-${day.good >= 0.95 ? "good" : day.good >= 0.5 ? "fair" : "poor"}${left ? " day-excluded" : ""}` },
    el("a", { href: at(`/#since=${day.day}T00:00:00Z&until=${until}`) },
      el("span", { class: "day-name" }, day.day),
      el("span", { class: "day-row" },
        day.thumbnail ? picture(day.thumbnail) : noPicture(),
        bar(day, low, high)),
      el("span", { class: "hint" }, [t("day_says", { mean: fixed(day.y_mm?.mean, 2) }), el("br"), t("complete", { percent: percent(day.completeness) }),
        left ? [el("br"), t("partly_excluded", { percent: percent(day.excluded) })] : null].flat().filter(Boolean))));
};

const dayTable = (days) => {
  const rows = days.map((day) => [day.day,
    ...["x_mm", "y_mm"].flatMap((axis) => ["min", "mean", "max"].map((part) => fixed(day[axis]?.[part]))),
    percent(day.completeness), percent(day.good), percent(day.excluded), t(`flag_${day.flag}`)]);
  const columns = [t("day"), ...[t("right_mm"), t("up_mm")].flatMap((axis) => ["minimum", "mean", "maximum"].map((part) => `${axis}, ${t(part)}`)),
    t("completeness"), t("flag_1"), t("excluded"), t("worst_flag")];
  return el("details", {}, el("summary", {}, t("table_of", { title: t("title_days") })), table(t("title_days"), columns, rows));
};

let [first, last, shown] = [0, 0, 0];

const show = (until) => fill(node, async () => {
  shown = until;
  const since = until - DAYS * DAY_S;
  const { days } = await getJson("/api/days", { since: iso(since), until: iso(until) });
  const there = days.filter((day) => day.y_mm?.min !== null && day.y_mm?.min !== undefined);
  const low = Math.min(...there.map((day) => day.y_mm.min));
  const high = Math.max(...there.map((day) => day.y_mm.max));
  const newest = [...days].sort((a, b) => b.day.localeCompare(a.day));
  const step = (name, by, there) => el("button", { type: "button", disabled: !there, onclick: () => show(until + by * DAYS * DAY_S) }, t(name));
  node.replaceChildren(
    there.length ? el("p", { class: "hint" }, t("days_scale", { low: fixed(low, 2), high: fixed(high, 2) })) : "",
    days.length ? el("ul", { class: "film" }, newest.map((day) => card(day, low, high))) : el("p", {}, t("no_days")),
    el("p", { class: "buttons" }, step("newer", 1, until <= last), step("older", -1, first < since)),
    dayTable(newest));
});

fill(node, async () => {
  const site = await getJson("/api/site");
  [first, last] = [site.span?.first, site.span?.last].map((time) => epoch(time ?? site.now));
  await show(Math.floor(last / DAY_S + 1) * DAY_S);
  if (site.building !== null) followBuilding(document.getElementById("building"), site.building, () => show(shown));
});
