// Alarms, gaps, ledger and events as tables.

import { STACK, at, below, el, epoch, getJson, iso, plain, pointName, t, table, timeElement } from "./page.js";

const page = document.getElementById("events-page");
const section = (name) => document.getElementById(name);

const link = (start, end) => {
  const [from, to] = [epoch(start), epoch(end ?? start)];
  const margin = Math.max(0.5 * (to - from), 1800);
  return el("a", { href: at(`/#since=${iso(from - margin)}&until=${iso(to + margin)}`) }, t("show_in_record"));
};

const PARTS = {
  alarms: (found) => [[t("name"), t("state_word"), t("since"), t("alarm_about")],
    found.map((alarm) => [alarm.name, alarm.state, timeElement(alarm.since), alarm.text || alarm.about])],
  gaps: (found) => [[t("start"), t("end"), t("slots_missed"), t("cause"), t("detail"), t("record")],
    found.map((gap) => [timeElement(gap.start), timeElement(gap.end), `${gap.slots}`, plain(gap.cause), gap.detail, link(gap.start, gap.end)])],
  ledger: (found) => [[t("start"), t("end"), t("kind"), t("point"), t("author"), t("text"), t("record")],
    found.map((entry) => [timeElement(entry.start), timeElement(entry.end), t(`kind_${entry.kind}`), entry.point ? pointName(entry.point) : t("all_points"), entry.author, entry.text, link(entry.start, entry.end)])],
  events: (found) => [[t("time"), t("kind"), t("detail")],
    found.map((event) => [timeElement(event.time, "second"), plain(event.kind), event.detail])],
};

/** Alarms that are only armed are folded up: what is raised must be seen at once. */
const shown = (name, columns, rows) => {
  if (!rows.length) return [el("p", {}, t("none"))];
  const folded = name === "alarms" ? rows.filter(([, state]) => state === "armed") : [];
  const open = rows.filter((row) => !folded.includes(row));
  return [
    open.length ? table(t(`heading_${name}`), columns, open, STACK) : el("p", {}, t("no_alarms")),
    folded.length ? el("details", {}, el("summary", {}, t("armed", { count: folded.length })), table(t("armed", { count: folded.length }), columns, folded, STACK)) : null,
  ].filter(Boolean);
};

const show = async ([name, make]) => {
  try {
    const found = (await getJson(`/api/${name}`))[name];
    const [columns, rows] = make(found);
    below(section(name), ...shown(name, columns, rows));
  } catch (error) {
    below(section(name), el("p", { class: "notice" }, t("failed", { text: error.message })));
  }
};

await Promise.all(Object.entries(PARTS).map(show));
page.dataset.state = "ready";
