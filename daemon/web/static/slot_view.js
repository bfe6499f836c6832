// One slot: its two frames with the targets drawn in, and its numbers.

import { STACK, at, el, epoch, fill, fixed, flagElement, getJson, iso, pointName, reasonsText, svg, t, table, timeElement, timeText, withSigma } from "./page.js";

const NUMBER_DIGITS = 6;

const marks = (found) =>
  found.map((target) => {
    if (target.outline) return svg("polygon", { class: "found", points: target.outline.map(([u, v]) => `${u},${v}`).join(" ") });
    if (target.r) return svg("circle", { class: "found", cx: target.u, cy: target.v, r: target.r });
    const arm = 2;
    return svg("path", { class: "found", d: `M${target.u - arm} ${target.v}h${2 * arm}M${target.u} ${target.v - arm}v${2 * arm}` });
  });

const around = (found) => {
  const us = found.flatMap((target) => (target.outline ? target.outline.map(([u]) => u) : [target.u - (target.r ?? 0), target.u + (target.r ?? 0)]));
  const vs = found.flatMap((target) => (target.outline ? target.outline.map(([, v]) => v) : [target.v - (target.r ?? 0), target.v + (target.r ?? 0)]));
  return [Math.min(...us), Math.min(...vs), Math.max(...us), Math.max(...vs)];
};

/** A frame as an SVG in its own pixels: pixel (0, 0) has its middle at the origin. */
class Frame {
  constructor(role, url, time, none) {
    const name = t(`frame_${role}`);
    this.note = el("p", { class: "hint" }, url ? t("targets_loading") : none);
    this.button = el("button", { type: "button", hidden: true, onclick: () => this.toggle() }, t("show_target"));
    this.node = el("figure", { class: "frame", "data-frame": role, "data-targets": url ? "loading" : "none" }, el("figcaption", {}, name, this.button));
    this.url = url;
    if (!url) {
      this.node.append(this.note);
      return;
    }
    this.image = svg("image", { href: url });
    this.svg = svg("svg", { role: "img", "aria-label": t("frame_alt", { camera: name, time }) }, this.image);
    this.node.append(this.svg, this.note);
    const probe = new Image();
    probe.onload = () => {
      this.size(probe.naturalWidth, probe.naturalHeight);
      this.node.dataset.image = "ready";
    };
    probe.onerror = () => {
      this.svg.remove();
      this.button.hidden = true;
      this.note.textContent = t("frame_gone");
      this.node.dataset.image = "failed";
    };
    probe.src = url;
  }

  size(width, height) {
    if (this.width) return; // the frame's own, by the targets, may be more than that of the picture
    this.setSize(width, height);
  }

  setSize(width, height) {
    this.width = width;
    this.height = height;
    this.svg.style.aspectRatio = `${width} / ${height}`; // a zoom must not move what stands below
    for (const [name, value] of Object.entries({ x: -0.5, y: -0.5, width, height })) this.image.setAttribute(name, value);
    this.view();
  }

  show(found, size, error) {
    if (!this.url || !this.svg.isConnected) return;
    if (size) this.setSize(...size);
    this.svg.append(...marks(found));
    this.note.textContent = found.length ? t("targets_found", { count: found.length }) : error ?? t("targets_none");
    this.node.dataset.targets = found.length ? "found" : "none";
    if (!found.length) return;
    this.box = around(found);
    this.button.hidden = false;
  }

  toggle() {
    this.isClose = !this.isClose;
    this.button.textContent = t(this.isClose ? "show_whole" : "show_target");
    this.view();
  }

  view() {
    if (!this.box || !this.isClose) {
      this.svg.setAttribute("viewBox", `-0.5 -0.5 ${this.width} ${this.height}`);
      return;
    }
    const [left, top, right, bottom] = this.box;
    const margin = 0.15 * Math.max(right - left, bottom - top) + 4;
    this.svg.setAttribute("viewBox", `${left - margin} ${top - margin} ${right - left + 2 * margin} ${bottom - top + 2 * margin}`);
  }
}

const points = (answer) => {
  const rows = Object.entries(answer.points ?? {}).map(([name, at]) => [
    pointName(name, at.role),
    withSigma(at.x_mm, at.sigma_x_mm), withSigma(at.y_mm, at.sigma_y_mm),
    fixed(at.raw_x_mm), fixed(at.raw_y_mm),
    el("span", {}, flagElement(at.flag ?? answer.flag), " ", reasonsText(at.reasons)),
  ]);
  if (!rows.length) return null;
  const [corrected, alone] = [t("corrected_mm"), t("alone_mm")];
  return table(t("slot"), [t("point"), `${t("right")}, ${corrected}`, `${t("up")}, ${corrected}`, `${t("right")}, ${alone}`, `${t("up")}, ${alone}`, t("flag")], rows, STACK);
};

const numbers = (answer) => {
  const text = (value) =>
    value === null || value === undefined ? "–"
      : typeof value === "number" ? (Number.isInteger(value) ? `${value}` : `${Number(value.toPrecision(NUMBER_DIGITS))}`)
        : typeof value === "object" ? JSON.stringify(value) : `${value}`;
  const rows = Object.entries(answer.numbers ?? {}).map(([name, value]) => [name, text(value)]);
  return rows.length ? el("details", {}, el("summary", {}, t("numbers")), el("p", { class: "hint" }, t("numbers_hint")), table(t("numbers"), [t("column"), t("value")], rows, { class: "numbers" })) : null;
};

/** What people have said of it, so that it is left out of figures and sums. */
const excluded = (entries) => entries.filter(({ kind }) => kind === "exclude")
  .map((entry) => el("p", { class: "notice" }, t("excluded_why", { text: [entry.text, entry.author && `(${entry.author})`, entry.point && `${t("point")}: ${entry.point}`].filter(Boolean).join(" ") })));

/** Fill a node with a slot; `go(slot)` is called for the one before or after. */
export const showSlot = async (node, slot, go) => {
  node.dataset.slot = slot;
  await fill(node, async () => {
    const answer = await getJson(`/api/slot/${encodeURIComponent(slot)}`);
    if (node.dataset.slot !== slot) return; // another one was asked for since
    const seconds = epoch(answer.slot ?? slot);
    const isGap = !Object.keys(answer.points ?? {}).length;
    const frames = ["main", "sub"].map((role) =>
      new Frame(role, answer.frames?.[role] ?? null, timeText(seconds, "second"), t(isGap ? "frame_never" : "frame_gone")));
    const step = (name, to) => el("button", { type: "button", "data-go": name, disabled: !to, onclick: () => go(iso(epoch(to))) }, t(name));
    const around = at(`/#since=${iso(seconds - 43200)}&until=${iso(seconds + 43200)}`);
    const focused = node.contains(document.activeElement) ? document.activeElement.dataset.go : null;
    node.replaceChildren(
      el("div", { class: "slot-head" },
        el("h2", {}, timeElement(seconds, "second")), flagElement(answer.flag), el("span", {}, isGap ? reasonsText(answer.reasons).replace(" + ", ": ") : reasonsText(answer.reasons)),
        el("span", { class: "buttons" }, step("previous", answer.previous), step("next", answer.next),
          node.id === "slot" ? null : el("a", { href: at(`/slot/${encodeURIComponent(slot)}`) }, t("as_page")), el("a", { href: around }, t("in_record")),
          answer.calibration ? el("a", { href: at(`/calibrations/${answer.calibration}`) }, `${t("calibration")} ${answer.calibration}`) : null)),
      ...excluded(answer.ledger ?? []),
      el("div", { class: "cameras" }, frames.map((frame) => frame.node)),
      ...[points(answer), numbers(answer)].filter(Boolean));
    if (focused) node.querySelector(`[data-go="${focused}"]:enabled`)?.focus();
    if (frames.some((frame) => frame.url)) drawTargets(node, slot, frames);
  });
};

const drawTargets = async (node, slot, frames) => {
  let found;
  try {
    found = await getJson(`/api/slot/${encodeURIComponent(slot)}/targets`);
  } catch (error) {
    found = { error: error.message };
  }
  if (node.dataset.slot !== slot) return;
  frames.forEach((frame, k) => {
    const role = ["main", "sub"][k];
    frame.show(found[role] ?? [], found.size?.[role], found.error);
  });
};

/** Arrow keys go to the slot before or after. */
export const slotKeys = (node) => (event) => {
  const name = { ArrowLeft: "previous", ArrowRight: "next" }[event.key];
  const scrolls = event.target.closest?.(".scroll");
  if (name && !scrolls && !event.altKey && !event.ctrlKey) node.querySelector(`[data-go="${name}"]:enabled`)?.click();
};
