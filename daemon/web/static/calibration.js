// The report of one calibration.

import { el, fill, getJson, t, table, timeElement } from "./page.js";

const node = document.getElementById("calibration");
const number = Number(node.dataset.number);

/** Figures as lines of a table: what is a list of named numbers has a line for each. */
const figureRows = (value, name = "") => {
  const isList = Array.isArray(value);
  if (value !== null && typeof value === "object" && !(isList && value.every((one) => typeof one !== "object"))) {
    return Object.entries(value).flatMap(([key, within]) =>
      figureRows(within, [name, isList ? `${Number(key) + 1}` : key].filter(Boolean).join(" · ")));
  }
  const text = (one) => (typeof one === "number" ? `${Number(one.toPrecision(5))}`.replace("-", "−") : `${one ?? "–"}`);
  return [[name, isList ? value.map(text).join(", ") : text(value)]];
};

fill(node, async () => {
  const { calibrations } = await getJson("/api/calibrations");
  const found = calibrations.find((entry) => entry.id === number);
  if (!found) {
    node.replaceChildren(el("p", {}, t("not_known")));
    return;
  }
  const figures = figureRows(found.figures);
  node.replaceChildren(
    el("p", {}, `${t("created")} `, timeElement(found.created), ` · ${t("method")}: ${found.method} · ${t("passed")}: `,
      el("span", { class: `flag ${found.passed ? "" : "flag-4"}` }, t(found.passed ? "yes" : "no")), found.active ? ` · ${t("active")}` : ""),
    el("h2", {}, t("report")), el("ul", {}, (found.lines ?? []).map((line) => el("li", {}, line))),
    ...(figures.length
      ? [el("details", {}, el("summary", {}, t("figures_count", { count: figures.length })), table(t("figures"), [t("name"), t("value")], figures, { class: "numbers" }))] : []));
});
