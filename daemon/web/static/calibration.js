// The report of one calibration.

import { el, fill, getJson, t, table, timeElement } from "./page.js";

const node = document.getElementById("calibration");
const number = Number(node.dataset.number);

fill(node, async () => {
  const { calibrations } = await getJson("/api/calibrations");
  const found = calibrations.find((entry) => entry.id === number);
  if (!found) {
    node.replaceChildren(el("p", {}, t("not_known")));
    return;
  }
  const figures = Object.entries(found.figures ?? {}).map(([name, value]) =>
    [name, typeof value === "number" ? `${Number(value.toPrecision(5))}` : Array.isArray(value) || typeof value === "object" ? JSON.stringify(value) : `${value}`]);
  node.replaceChildren(
    el("p", {}, timeElement(found.created), ` · ${found.method} · ${t("passed")}: ${t(found.passed ? "yes" : "no")}${found.active ? ` · ${t("active")}` : ""}`),
    el("h2", {}, t("report")), el("ul", {}, (found.lines ?? []).map((line) => el("li", {}, line))),
    ...(figures.length ? [el("h2", {}, t("figures")), table(t("figures"), [t("name"), t("value")], figures, { class: "numbers" })] : []));
});
