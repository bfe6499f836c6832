// All sites: a map of those with a position, and a list of all, worst first.

import { below, el, getJson, svg, t, table, timeElement } from "./page.js";

const mapNode = document.getElementById("map");
const sumsNode = document.getElementById("sums");
const listNode = document.getElementById("sites");
const REFRESH_S = 30;
const MOST_ROWS = 200;
const [MARGIN, LEAST_HEIGHT, SHARE_OF_HEIGHT, SHARE_OF_WIDTH] = [40, 220, 0.42, 0.8];
const KM_PER_DEG = 111.32;
const LEAST_KM = 1;
const [LABEL_PX, LETTER_PX] = [14, 7.5];
const RADII = [5, 6.5, 8, 8]; // a level shows by more than its colour
const MOST_NAMES = 200;

// The map: a degree of longitude is narrower than one of latitude, as it is in the middle of the sites.

const projection = (sites, [width, height]) => {
  const latitudes = sites.map((site) => site.latitude_deg);
  const longitudes = sites.map((site) => site.longitude_deg);
  const span = (values) => values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
  const [south, north] = span(latitudes);
  const [west, east] = span(longitudes);
  const narrower = Math.max(0.05, Math.cos(((south + north) / 2) * (Math.PI / 180)));
  const wideKm = Math.max((east - west) * KM_PER_DEG * narrower, LEAST_KM);
  const tallKm = Math.max((north - south) * KM_PER_DEG, LEAST_KM);
  const pxPerKm = Math.min((width - 2 * MARGIN) / wideKm, (height - 2 * MARGIN) / tallKm);
  const place = (site) => [
    width / 2 + (site.longitude_deg - (west + east) / 2) * KM_PER_DEG * narrower * pxPerKm,
    height / 2 - (site.latitude_deg - (south + north) / 2) * KM_PER_DEG * pxPerKm,
  ];
  return { place, pxPerKm };
};

const scaleBar = (pxPerKm, [width, height]) => {
  const most = width / 5 / pxPerKm;
  const power = 10 ** Math.floor(Math.log10(most));
  const km = power * ([5, 2, 1].find((step) => step * power <= most) ?? 1);
  const text = km >= 1 ? `${km} km` : `${Math.round(1000 * km)} m`;
  const y = height - 14;
  return svg("g", { class: "scale" },
    svg("path", { d: `M${LABEL_PX} ${y - 6}V${y}H${LABEL_PX + km * pxPerKm}V${y - 6}` }),
    svg("text", { x: LABEL_PX + km * pxPerKm + 8, y }, text));
};

/** Names beside their marks, where they cover nothing; the worst come first. */
const labels = (marks, [width]) => {
  const taken = marks.map(({ x, y, radius }) => [x - radius, y - radius, x + radius, y + radius]);
  const free = ([left, top, right, bottom]) => left >= 0 && right <= width
    && !taken.some(([l, t, r, b]) => left < r && right > l && top < b && bottom > t);
  return marks.slice(0, MOST_NAMES).map(({ site, x, y, radius }) => {
    const wide = site.site.length * LETTER_PX;
    const boxes = [x + radius + 3, x - radius - 3 - wide].map((left) => [left, y - LABEL_PX / 2, left + wide, y + LABEL_PX / 2]);
    const box = boxes.find(free);
    if (!box) return null;
    taken.push(box);
    return svg("text", { x: box[0], y: y + 4.5 }, site.site);
  });
};

const mark = (level, place) => svg("circle", { class: `level-${level}`, ...place, r: RADII[level] });

/** What the marks mean, of those levels that there are. */
const legend = (sites) => el("p", { class: "levels hint" },
  [0, 1, 2, 3].filter((level) => sites.some((site) => site.level === level)).map((level) =>
    el("span", {}, svg("svg", { class: "map-mark", viewBox: "0 0 18 18", "aria-hidden": "true" }, mark(level, { cx: 9, cy: 9 })), ` ${t(`level_${level}`)}`)));

/** Pixels of the screen, so that names are as large on a phone. */
const mapSize = () => {
  const width = Math.max(mapNode.clientWidth, LEAST_HEIGHT);
  return [width, Math.max(LEAST_HEIGHT, Math.min(SHARE_OF_WIDTH * width, SHARE_OF_HEIGHT * innerHeight))];
};

const drawMap = (sites) => {
  const there = sites.filter((site) => site.latitude_deg !== null);
  if (!there.length) return [el("p", { class: "hint" }, t("no_position"))];
  const size = mapSize();
  const { place, pxPerKm } = projection(there, size);
  const marks = there.map((site) => { const [x, y] = place(site); return { site, x, y, radius: RADII[site.level] }; });
  const circles = [...marks].reverse().map(({ site, x, y }) => // the worst lie on top
    svg("a", { href: site.page, tabindex: -1, "aria-label": site.site }, // the list has the same, in an order
      svg("title", {}, `${site.site}: ${t(`level_${site.level}`)}; ${site.text}`), mark(site.level, { cx: x, cy: y })));
  const without = sites.filter((site) => site.latitude_deg === null).map(({ site }) => site);
  const named = without.slice(0, 20).join(", ") + (without.length > 20 ? ", ..." : "");
  return [
    svg("svg", { class: "map", viewBox: `0 0 ${size.join(" ")}`, role: "group", "aria-label": t("map_alt", { count: there.length }) },
      circles, labels(marks, size), scaleBar(pxPerKm, size)),
    legend(there),
    without.length ? el("p", { class: "hint" }, t("without_position", { sites: named })) : null,
  ];
};

// The list

const row = (site) => [
  el("a", { href: site.page }, site.site),
  el("span", { class: `level level-${site.level}` }, t(`level_${site.level}`)),
  timeElement(site.last_slot), timeElement(site.heard), site.text,
];

const find = el("input", { type: "search", "aria-label": t("find_site"), placeholder: t("find_site"), oninput: () => showList() });
const rows = el("div", {});
let all = [];

const showList = () => {
  const wanted = find.value.trim().toLowerCase();
  const found = all.filter(({ site }) => site.toLowerCase().includes(wanted));
  const more = found.length - MOST_ROWS;
  rows.replaceChildren(...[
    table(t("all_sites"), [t("site"), t("state"), t("last_slot"), t("heard"), t("what")], found.slice(0, MOST_ROWS).map(row), { class: "sites stack" }),
    more > 0 ? el("p", { class: "hint" }, t("and_more", { count: more })) : null,
  ].filter(Boolean));
};

let shown = null;
const refresh = async () => {
  try {
    const { sites, sums } = await getJson("/api/sites");
    sumsNode.textContent = t("sums", sums);
    const text = JSON.stringify(sites);
    if (text !== shown) {
      all = sites;
      below(mapNode, ...drawMap(sites));
      showList();
      if (!sites.length) below(listNode, el("p", {}, t("no_sites")));
      else if (!listNode.contains(rows)) below(listNode, find, rows);
      mapNode.dataset.state = listNode.dataset.state = "ready";
    }
    shown = text;
  } catch (error) {
    shown = null;
    below(listNode, el("p", { class: "notice", role: "alert" }, t("failed", { text: error.message })));
    mapNode.dataset.state = listNode.dataset.state = "failed";
  } finally {
    setTimeout(refresh, 1000 * REFRESH_S);
  }
};
refresh();

let drawnWidth = innerWidth;
addEventListener("resize", () => {
  if (drawnWidth !== innerWidth && all.length) below(mapNode, ...drawMap(all));
  drawnWidth = innerWidth;
});
