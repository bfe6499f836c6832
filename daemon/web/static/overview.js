// The first page: how it is doing, and the record.

import { below, duration, el, getJson, percent, pointName, reasonsText, t, table, timeElement, withSigma, flagElement } from "./page.js";
import { RecordFigure } from "./figure.js";

const state = document.getElementById("state");
const figureNode = document.getElementById("figure");
const dialog = document.getElementById("slot-dialog");

// A slot over the figures

const view = el("section", {});
const slotView = () => import("./slot_view.js"); // not needed for the first figure
dialog.append(el("button", { type: "button", class: "close", onclick: () => dialog.close() }, t("close")), view);
dialog.addEventListener("keydown", async (event) => (await slotView()).slotKeys(view)(event));
dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
const openSlot = async (slot) => {
  const { showSlot } = await slotView();
  if (!dialog.open) dialog.showModal();
  return showSlot(view, slot, openSlot);
};
view.addEventListener("click", (event) => {
  if (event.target.closest("a[href*='/#']")) dialog.close();
});

// How it is doing

const lastValues = (last) => {
  if (!last?.slot) return el("p", {}, t("no_row"));
  const rows = Object.entries(last.points ?? {}).map(([name, at]) => [
    pointName(name, at.role),
    el("strong", {}, withSigma(at.x_mm, at.sigma_x_mm)),
    el("strong", {}, withSigma(at.y_mm, at.sigma_y_mm)),
    el("span", {}, flagElement(at.flag), " ", reasonsText(at.reasons)),
  ]);
  return el("div", {},
    table(t("last_value"), [t("point"), `${t("right")}, mm`, `${t("up")}, mm`, t("flag")], rows),
    el("p", { class: "hint" }, timeElement(last.slot), `, ${t("ago", { age: duration(last.age_s) })}`));
};

const troubles = (items) => {
  const wrong = items.filter(({ level }) => level > 0).sort((a, b) => b.level - a.level);
  const list = wrong.length
    ? el("ul", { class: "items" }, wrong.map((item) => el("li", { class: `level-${item.level}` },
      el("strong", {}, item.name), ` ${item.text}`, item.what_to_do ? el("span", { class: "do" }, ` → ${item.what_to_do}`) : null)))
    : el("p", {}, t("nothing_wrong"));
  const fine = items.filter(({ level }) => level === 0);
  return el("div", {}, el("h3", {}, t("wrong")), list,
    fine.length ? el("details", {}, el("summary", {}, t("in_order", { names: fine.map(({ name }) => name).join(", ") })),
      el("ul", { class: "items" }, fine.map((item) => el("li", {}, el("strong", {}, item.name), ` ${item.text}`)))) : null);
};

const alarms = (list) => {
  if (!list?.length) return null;
  const armed = list.filter(({ state }) => state === "armed");
  const others = list.filter(({ state }) => state !== "armed");
  return el("div", {}, el("h3", {}, t("alarms")),
    others.length ? el("ul", { class: "items" }, others.map((alarm) => el("li", { class: `alarm-${alarm.state}` },
      el("strong", {}, alarm.name), ` ${alarm.state} `, alarm.text ?? ""))) : el("p", {}, t("no_alarms")),
    el("details", {}, el("summary", {}, t("armed", { count: armed.length })),
      el("ul", { class: "items" }, armed.map(({ name, about }) => el("li", {}, el("strong", {}, name), ` ${about}`)))));
};

const verdict = ({ verdict: { level, word }, items = [] }) => {
  const names = items.filter((item) => level > 0 && item.level === level).map(({ name }) => name);
  return names.length ? `${word}: ${names.join(", ")}` : word;
};

const showState = (overview) => {
  state.dataset.level = overview.verdict.level;
  const shares = { h24: percent(overview.coverage?.h24), d30: percent(overview.coverage?.d30) };
  below(state,
    el("p", { class: `verdict level-${overview.verdict.level}` }, verdict(overview)),
    el("div", { class: "cards" },
      el("div", {}, el("h3", {}, t("last_value")), lastValues(overview.last),
        el("p", { class: "hint" }, `${t("coverage")} ${t("coverage_text", shares)}`)),
      troubles(overview.items ?? []), alarms(overview.alarms)));
  state.dataset.state = "ready";
};

const failed = (error) => {
  below(state, el("p", { class: "notice", role: "alert" }, t("failed", { text: error.message })));
  state.dataset.state = "failed";
};

let shown = null;
const refresh = async () => {
  let next = 60;
  try {
    const overview = await getJson("/api/overview");
    const text = JSON.stringify(overview);
    if (text !== shown) showState(overview);
    shown = text;
    next = overview.refresh_s ?? next;
  } catch (error) {
    failed(error);
  } finally {
    setTimeout(refresh, 1000 * next);
  }
};

// The figure goes first: the verdict, and a reference that takes seconds, wait for its values.

const followed = async (figure, share) => {
  const { followBuilding } = await import("./building.js");
  followBuilding(document.getElementById("building"), share, () => figure.again());
};

const showReference = async (figure) => {
  try {
    const { reference, marks } = await getJson("/api/comparison");
    figure.lay(reference, marks);
  } catch (error) {
    figureNode.append(el("p", { class: "notice" }, t("reference_failed", { text: error.message })));
  }
};

/** uPlot, whose script comes after this one: values are asked for before it is read. */
const chart = new Promise((done, fail) => {
  const script = document.getElementById("chart");
  script.addEventListener("load", done);
  script.addEventListener("error", () => fail(new Error(t("no_chart"))));
});

try {
  const site = JSON.parse(document.getElementById("begin").textContent) ?? await getJson("/api/site");
  const figure = new RecordFigure(figureNode, site, openSlot, chart);
  await figure.asking;
  if (site.building !== null) followed(figure, site.building);
  if (site.reference) showReference(figure);
} catch (error) {
  below(figureNode, el("p", { class: "notice" }, t("failed", { text: error.message })));
  figureNode.dataset.state = "failed";
}
refresh();
