// What the record says over weeks and years, as sentences and tables; and a reference beside it.

import { STACK, below, el, epoch, fixed, getJson, iso, percent, t, table, timeElement } from "./page.js";

const section = document.getElementById("analysis");
const beside = document.getElementById("comparison");
const form = document.getElementById("asked");
const DAY_S = 86400;
const SPANS = [["90d", 90], ["1y", 365], ["all", null]];

const interval = ({ value, low, high }, digits = 3) =>
  `${fixed(value, digits)} [${fixed(low, digits)}, ${fixed(high, digits)}]`;

const part = (title, columns, rows, attributes = {}) =>
  rows.length ? [el("h3", {}, title), table(title, columns, rows, attributes)] : [];

const trendRows = ({ trend, drift }) => [
  ...(trend ? [[t("whole_span"), interval(trend.mm_per_year), t(trend.seasonal ? "trend_whole" : "trend_short")]] : []),
  ...(drift ? [[t("last_days", { days: drift.days.toFixed(0) }), interval(drift.mm_per_year), t(drift.significant ? "drift" : "no_drift")]] : []),
];

const tables = (found) => [
  ...part(t("temperature_share"), [t("name"), t("mm_per_unit"), t("lag_h")],
    (found.temperature?.readings ?? []).map((one) => [one.slow ? t("slow_part", one) : one.name, `${interval(one.mm_per_unit, 4)} mm/${one.unit === "degC" ? "K" : one.unit}`, interval(one.lag_h, 2)])),
  ...part(t("trend"), [t("span"), t("mm_per_year"), t("meaning")], trendRows(found)),
  ...part(t("steps"), [t("time"), t("step_mm"), t("at_earliest"), t("at_latest")],
    (found.steps?.found ?? []).map((step) => [timeElement(step.time_utc), interval(step.mm), timeElement(step.earliest_utc), timeElement(step.latest_utc)]), STACK),
  ...part(t("creep"), [t("days_after_loading"), `mm, ${t("of_all_laws")}`],
    (found.creep?.predictions ?? []).map((one) => [fixed(one.days, 0), interval(one.mm)])),
  ...part(t("days_table"), [t("day"), `${t("minimum")}, mm`, `${t("mean")}, mm`, `${t("maximum")}, mm`, t("number"), t("completeness")],
    found.days.toReversed().map((day) => [day.day, fixed(day.min_mm), fixed(day.mean_mm), fixed(day.max_mm), `${day.rows}`, percent(day.completeness)])),
];

const TIMES = /(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ)/;

/** Sentences whose times follow the choice of zone, as those of the tables do. */
const sentences = (lines) => el("ul", { class: "items" }, lines.map((line) =>
  el("li", {}, ...line.split(TIMES).map((piece, k) => (k % 2 ? timeElement(piece) : piece)))));

const compared = (one) => [
  el("h3", {}, `${one.point} ${one.axis}`), sentences(one.sentences),
  ...(one.differences.length
    ? [table(`${one.point} ${one.axis}`, [t("time"), t("record_mm"), t("reference_mm"), t("difference_mm"), t("e_n")],
      one.differences.map((each) => [timeElement(each.time), fixed(each.row_mm), fixed(each.reference_mm),
        `${fixed(each.difference_mm)}\u00a0±\u00a0${fixed(each.sigma_mm)}`, fixed(each.e_n, 2)]), STACK)] : []),
];

let latest = 0;
const filled = async (node, path, parameters, make) => {
  const mine = latest;
  node.dataset.state = "loading";
  below(node, el("p", {}, t("analysis_loading")));
  try {
    const children = make(await getJson(path, parameters));
    if (mine !== latest) return; // something else was asked meanwhile
    below(node, ...children.flat(2));
    node.dataset.state = "ready";
  } catch (error) {
    if (mine !== latest) return;
    below(node, el("p", { class: "notice", role: "alert" }, t("failed", { text: error.message })));
    node.dataset.state = "failed";
  }
};

const select = (name, label, options) => el("label", {}, label, el("select", { name }, options.map(([value, text]) => el("option", { value }, text))));

const makeForm = (site) => {
  const points = site.points.filter(({ role }) => role !== "fixed").map(({ name }) => [name, name === "main" ? t("main_point") : name]);
  form.append(
    select("point", t("point"), points), select("axis", t("direction"), [["y", t("up")], ["x", t("right")]]),
    select("days", t("span"), SPANS.map(([name, days]) => [days ?? "", t(`span_${name}`)])),
    el("label", {}, t("loaded_on"), el("input", { type: "date", name: "loaded" })), el("button", {}, t("go")));
};

const show = (site) => {
  latest += 1;
  const { point, axis, days, loaded } = Object.fromEntries(new FormData(form));
  const last = epoch(site.span?.last);
  const span = days && last !== null ? { since: iso(last - days * DAY_S), until: iso(last + 1) } : {};
  return Promise.all([
    filled(section, "/api/analysis", { point, axis, ...span, ...(loaded ? { loaded } : {}) },
      (found) => [sentences(found.sentences), el("p", { class: "hint" }, t("analysis_hint", { percent: 100 * found.confidence })), tables(found)]),
    filled(beside, "/api/comparison", span, (found) =>
      found.reference === null ? [el("p", {}, t("no_reference"))] : [el("p", {}, found.reference), found.comparisons.map(compared)]),
  ]);
};

try {
  const site = await getJson("/api/site");
  makeForm(site);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    show(site);
  });
  await show(site);
} catch (error) {
  below(section, el("p", { class: "notice", role: "alert" }, t("failed", { text: error.message })));
  section.dataset.state = "failed";
}
