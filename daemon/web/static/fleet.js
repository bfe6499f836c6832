// All sites: a map of those with a position, and a list of all, worst first.

import { below, el, getJson, svg, t, table, timeElement } from "./page.js";

const mapNode = document.getElementById("map");
const sumsNode = document.getElementById("sums");
const listNode = document.getElementById("sites");
const REFRESH_S = 30;
const MOST_ROWS = 200;
const [WIDTH, HEIGHT, MARGIN] = [1000, 560, 40];
const KM_PER_DEG = 111.32;
const LEAST_KM = 1;
const [RADIUS, LABEL_PX, LETTER_PX] = [6, 14, 7.5];
const MOST_NAMES = 200;

// The map: a degree of longitude is narrower than one of latitude, as it is in the middle of the sites.

const projection = (sites) => {
  const latitudes = sites.map((site) => site.latitude_deg);
  const longitudes = sites.map((site) => site.longitude_deg);
  const span = (values) => values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
  const [south, north] = span(latitudes);
  const [west, east] = span(longitudes);
  const narrower = Math.max(0.05, Math.cos(((south + north) / 2) * (Math.PI / 180)));
  const wideKm = Math.max((east - west) * KM_PER_DEG * narrower, LEAST_KM);
  const tallKm = Math.max((north - south) * KM_PER_DEG, LEAST_KM);
  const pxPerKm = Math.min((WIDTH - 2 * MARGIN) / wideKm, (HEIGHT - 2 * MARGIN) / tallKm);
  const place = (site) => [
    WIDTH / 2 + (site.longitude_deg - (west + east) / 2) * KM_PER_DEG * narrower * pxPerKm,
    HEIGHT / 2 - (site.latitude_deg - (south + north) / 2) * KM_PER_DEG * pxPerKm,
  ];
  return { place, pxPerKm };
};

const scaleBar = (pxPerKm) => {
  const most = 200 / pxPerKm;
  const power = 10 ** Math.floor(Math.log10(most));
  const km = power * ([5, 2, 1].find((step) => step * power <= most) ?? 1);
  const text = km >= 1 ? `${km} km` : `${Math.round(1000 * km)} m`;
  const y = HEIGHT - 14;
  return svg("g", { class: "scale" },
    svg("path", { d: `M${MARGIN} ${y - 6}V${y}H${MARGIN + km * pxPerKm}V${y - 6}` }),
    svg("text", { x: MARGIN + km * pxPerKm + 8, y }, text));
};

/** Names beside their marks, where they cover nothing; the worst come first. */
const labels = (marks) => {
  const taken = marks.map(({ x, y }) => [x - RADIUS, y - RADIUS, x + RADIUS, y + RADIUS]);
  return marks.slice(0, MOST_NAMES).map(({ site, x, y }) => {
    const wide = site.site.length * LETTER_PX;
    const left = x + 9 + wide > WIDTH ? x - 9 - wide : x + 9;
    const box = [left, y - LABEL_PX / 2, left + wide, y + LABEL_PX / 2];
    if (taken.some(([l, top, r, bottom]) => box[0] < r && box[2] > l && box[1] < bottom && box[3] > top)) return null;
    taken.push(box);
    return svg("text", { x: left, y: y + 4.5 }, site.site);
  });
};

const drawMap = (sites) => {
  const there = sites.filter((site) => site.latitude_deg !== null);
  if (!there.length) return [el("p", { class: "hint" }, t("no_position"))];
  const { place, pxPerKm } = projection(there);
  const marks = there.map((site) => { const [x, y] = place(site); return { site, x, y }; });
  const circles = [...marks].reverse().map(({ site, x, y }) => // the worst lie on top
    svg("a", { href: site.page, tabindex: -1, "aria-label": site.site }, // the list has the same, in an order
      svg("circle", { class: `level-${site.level}`, cx: x, cy: y, r: RADIUS },
        svg("title", {}, `${site.site}: ${t(`level_${site.level}`)}; ${site.text}`))));
  const without = sites.filter((site) => site.latitude_deg === null).map(({ site }) => site);
  const named = without.slice(0, 20).join(", ") + (without.length > 20 ? ", ..." : "");
  return [
    svg("svg", { class: "map", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "group", "aria-label": t("map_alt", { count: there.length }) },
      circles, labels(marks), scaleBar(pxPerKm)),
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
    table(t("all_sites"), [t("site"), t("state"), t("last_slot"), t("heard"), t("what")], found.slice(0, MOST_ROWS).map(row)),
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
