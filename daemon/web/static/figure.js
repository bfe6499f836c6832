// The figures over one span of time: what is shown, how it is moved, which data it asks for.

import { el, epoch, getJson, iso, midnight, recall, remember, t, timeText } from "./page.js";
import { listen } from "./gestures.js";
import { forgetColours } from "./lines.js";
import { AXIS_PX, Panel } from "./panel.js";
import { laneRows, readSpans, shadedByKind, slide, spansAt } from "./spans.js";

const SHORTEST_S = 60;
const LONGEST_S = 11 * 366 * 86400;
const SETTLE_MS = 60;
const SPANS_PX = 2; // flags and gaps nearer to each other are one: a long record has thousands
const PRESETS = [["1h", 3600], ["24h", 86400], ["7d", 604800], ["30d", 30 * 86400], ["1y", 365 * 86400], ["all", null]];

/** The figures that an overview's points and readings allow. */
export const panelSpecs = (overview, point) => {
  const line = (quantity, label, more = {}) => ({ quantity, label, ...more });
  const value = (axis) => line(`${axis}_mm.${point}`, t("line_corrected"), { sigma: `sigma_${axis}_mm.${point}` });
  const single = (axis) => [line(`raw_${axis}_mm.${point}`, t("line_raw"), { hue: 1 }), line(`${axis}_mm.${point}`, t("line_corrected"), { hue: 0 })];
  const mm = { unit: "mm", digits: 3 };
  const celsius = [
    line("temperature_main_c", t("line_main_camera")), line("temperature_sub_c", t("line_sub_camera")),
    ...overview.readings.filter(({ unit }) => unit === "degC").map(({ name }) => line(`reading_${name}`, name)),
  ];
  const units = [...new Set(overview.readings.map(({ unit }) => unit).filter((unit) => unit !== "degC"))];
  const measured = overview.points.filter(({ role }) => role !== "fixed");
  const specs = [
    { id: "y", title: t("panel_y"), ...mm, lines: [value("y")], height: 210 },
    { id: "single_y", title: t("panel_single_y"), ...mm, lines: single("y") },
    ...(overview.points.some(({ role }) => role === "fixed")
      ? [{ id: "closure", title: t("panel_closure"), ...mm, zero: true, mixed: true, lines: [["x", "right"], ["y", "up"]].map(([axis, name]) => line(`closure_${axis}_mm`, t(name))) }] : []),
    { id: "temperature", title: t("panel_temperature"), unit: "°C", digits: 1, least: 0.1, lines: celsius },
    { id: "x", title: t("panel_x"), ...mm, lines: [value("x")] },
    { id: "single_x", title: t("panel_single_x"), ...mm, lines: single("x") },
    { id: "rotation", title: t("panel_rotation"), unit: "mrad", digits: 4, mixed: true, lines: ["x", "y", "z"].map((axis) => line(`r${axis}_rad`, t("about", { axis }), { factor: 1000 })) },
    { id: "translation", title: t("panel_translation"), ...mm, mixed: true, lines: ["x", "y", "z"].map((axis) => line(`t${axis}_mm`, t("along", { axis }))) },
    ...(measured.length > 1
      ? [{ id: "points_y", title: t("panel_points_y"), ...mm, mixed: true, lines: measured.map(({ name }) => line(`y_mm.${name}`, name)) }] : []),
    ...units.map((unit) => ({
      id: `readings_${unit}`, title: t("panel_readings", { unit }), unit, lines: overview.readings
        .filter((reading) => reading.unit === unit).map(({ name }) => line(`reading_${name}`, name)),
    })),
  ];
  return specs.map((spec) => ({ ...spec, lines: spec.lines.map((entry, k) => ({ hue: k % 6, ...entry })) }));
};

const DEFAULT_PANELS = ["y", "single_y", "closure", "temperature"];

export class RecordFigure {
  /** `chart` is a promise of uPlot: the values are asked for while it loads. */
  constructor(node, overview, openSlot, chart) {
    this.node = node;
    this.overview = overview;
    this.openSlot = openSlot;
    this.chart = chart;
    this.first = epoch(overview.span?.first) ?? epoch(overview.now) - 3600;
    this.last = epoch(overview.span?.last) ?? epoch(overview.now);
    this.point = "main";
    this.index = null;
    this.spans = [];
    this.marks = [];
    this.panels = [];
    this.width = node.clientWidth;
    this.chosen = new Set((recall("panels", null)?.split(" ") ?? DEFAULT_PANELS));
    this.withoutExcluded = new URLSearchParams(location.hash.slice(1)).get("excluded") === "out";
    [this.since, this.until] = this.fromAddress() ?? [Math.max(this.first, this.last - 7 * 86400), this.last + 60];
    this.sight = new IntersectionObserver((entries) => this.seen(entries), { rootMargin: "100px" });
    this.choosePanels();
    this.makeTools();
    this.placePanels();
    new ResizeObserver(() => this.resized()).observe(this.panelBox);
    addEventListener("hashchange", () => {
      const asked = this.fromAddress();
      if (asked && (asked[0] !== Math.round(this.since) || asked[1] !== Math.round(this.until))) this.go(...asked);
    });
    document.addEventListener("zone", () => this.renew());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  fromAddress() {
    const asked = new URLSearchParams(location.hash.slice(1));
    const since = epoch(asked.get("since"));
    const until = epoch(asked.get("until"));
    return since < until ? [since, until] : null;
  }

  // What stands around the figures

  makeTools() {
    const button = (text, action, more = {}) => el("button", { type: "button", onclick: action, ...more }, text);
    const step = (text, label, action) => button(text, action, { "aria-label": label, title: label });
    this.presets = PRESETS.map(([name, seconds]) => button(t(`span_${name}`), () => this.preset(seconds), { "data-span": name }));
    this.from = el("input", { type: "date", required: true });
    this.to = el("input", { type: "date", required: true });
    this.readout = el("p", { class: "readout" });
    this.said = el("p", { class: "unseen", "aria-live": "polite" });
    const points = this.overview.points.filter(({ role }) => role !== "fixed");
    this.pointSelect = points.length > 1 ? el("label", {}, t("point"), el("select", { onchange: (event) => this.choosePoint(event.target.value) },
      points.map(({ name }) => el("option", { value: name }, name === "main" ? t("main_point") : name)))) : null;
    this.choices = el("div", { role: "group", "aria-label": t("panels") });
    this.lanes = el("div", { class: "lanes" });
    this.panelBox = el("div", { class: "panels", tabindex: 0, role: "group", "aria-label": t("record"), "aria-describedby": "figure-help", onkeydown: (event) => this.key(event) });
    const heading = this.node.querySelector("h2");
    this.node.replaceChildren(heading,
      el("div", { class: "tools" },
        el("div", { class: "buttons", role: "group", "aria-label": t("span") }, this.presets),
        el("div", { class: "buttons" },
          step("←", t("earlier"), () => this.pan(-0.5)), step("→", t("later"), () => this.pan(0.5)),
          step("+", t("zoom_in"), () => this.zoom(0.5, 0.5)), step("−", t("zoom_out"), () => this.zoom(2, 0.5))),
        el("form", { class: "dates", onsubmit: (event) => this.submit(event) },
          el("label", {}, t("from"), this.from), el("label", {}, t("to"), this.to), el("button", {}, t("go"))),
        this.pointSelect,
        el("label", {}, el("input", { type: "checkbox", checked: this.withoutExcluded, onchange: (event) => this.leaveOut(event.target.checked) }), t("without_excluded"))),
      el("details", { class: "choices", open: innerWidth > 700 }, el("summary", {}, t("panels")), this.choices), this.readout, this.said, this.lanes, this.panelBox,
      el("details", { class: "help" }, el("summary", {}, t("help")), el("p", { id: "figure-help" }, t("figure_help"))));
  }

  /** Make the panels that are chosen, but for those that are there; ask for what they show. */
  choosePanels() {
    this.specs = panelSpecs(this.overview, this.point);
    const there = new Map(this.panels.map((panel) => [panel.spec.id, panel]));
    const hooks = { started: (panel) => this.listen(panel), pointed: (panel, u) => this.pointed(panel, u) };
    this.panels = this.specs.filter(({ id }) => this.chosen.has(id)).map((spec) => there.get(spec.id) ?? new Panel(spec, hooks));
    for (const panel of there.values()) if (!this.panels.includes(panel)) panel.u?.destroy();
    for (const panel of this.panels) panel.lay(this.reference, this.marks);
    this.sight.disconnect();
    for (const { node } of this.panels) this.sight.observe(node);
    this.again();
  }

  placePanels() {
    this.choices.replaceChildren(...this.specs.map((spec) => el("label", {},
      el("input", { type: "checkbox", checked: this.chosen.has(spec.id), onchange: (event) => this.choosePanel(spec.id, event.target.checked) }),
      spec.title)));
    this.panelBox.replaceChildren(...this.panels.map((panel) => panel.node));
  }

  listen(panel) {
    listen(panel.u.over, {
      zoom: (factor, share) => this.zoom(factor, share),
      pan: (share) => this.pan(share),
      show: (from, to) => this.showSelection(from, to),
      pick: (from, to) => this.pick(from, to),
      click: (x, y) => this.clicked(panel, x, y),
    });
  }

  /** Lay a reference over the values: marks of /api/comparison. */
  lay(name, marks) {
    this.reference = name;
    this.marks = marks;
    for (const panel of this.panels) panel.lay(name, marks);
    this.draw();
    this.settle();
  }

  choosePanel(id, wanted) {
    if (wanted) this.chosen.add(id);
    else this.chosen.delete(id);
    remember("panels", [...this.chosen].join(" "));
    this.choosePanels();
    this.panelBox.replaceChildren(...this.panels.map((panel) => panel.node));
  }

  leaveOut(wanted) {
    this.withoutExcluded = wanted;
    this.again();
  }

  choosePoint(name) {
    this.point = name;
    for (const { u } of this.panels) u?.destroy();
    this.panels = [];
    this.choosePanels();
    this.placePanels();
  }

  // Which span is shown

  preset(seconds) {
    if (seconds === null) this.go(this.first, this.last + 60);
    else {
      const until = Math.min(this.until, this.last + 60);
      this.go(until - seconds, until);
    }
  }

  submit(event) {
    event.preventDefault();
    const after = iso(Date.parse(`${this.to.value}T00:00:00Z`) / 1000 + 86400).slice(0, 10);
    const [since, until] = [midnight(this.from.value), midnight(after)];
    if (since < until) this.go(since, until);
  }

  zoom(factor, share) {
    const span = this.until - this.since;
    const wanted = Math.min(LONGEST_S, Math.max(SHORTEST_S, factor * span));
    const since = this.since + share * (span - wanted);
    this.go(since, since + wanted);
  }

  pan(share) {
    const by = share * (this.until - this.since);
    this.go(this.since + by, this.until + by);
  }

  pick(from, to) {
    const span = this.until - this.since;
    const [a, b] = [Math.min(from, to), Math.max(from, to)].map((share) => Math.min(1, Math.max(0, share)));
    const middle = this.since + (span * (a + b)) / 2;
    const half = Math.max(SHORTEST_S, span * (b - a)) / 2;
    this.go(middle - half, middle + half);
  }

  showSelection(from, to) {
    for (const { u } of this.drawn) {
      const width = u.over.clientWidth;
      const [left, right] = from === null ? [0, 0] : [Math.min(from, to) * width, Math.max(from, to) * width];
      u.setSelect({ left, width: right - left, top: 0, height: u.over.clientHeight }, false);
    }
  }

  /** Show a span: at once with the data that are there, then with its own. */
  go(since, until) {
    const span = Math.min(LONGEST_S, Math.max(SHORTEST_S, until - since));
    const middle = (since + until) / 2;
    this.since = middle - span / 2;
    this.until = middle + span / 2;
    this.node.dataset.state = "loading";
    delete this.node.dataset.settled;
    if (this.drawn.length) this.frame ??= requestAnimationFrame(() => this.draw());
    clearTimeout(this.timer);
    if (this.isCovered()) this.settle();
    else if (this.idle ?? true) this.asking = this.ask();
    else this.timer = setTimeout(() => this.ask(), SETTLE_MS);
  }

  /** Ask again for what is shown: there may be more of it. */
  again() {
    this.answer = null;
    this.go(this.since, this.until);
  }

  draw() {
    this.frame = null;
    for (const panel of this.panels) if (!panel.u || panel.inSight) this.drawPanel(panel);
    if (this.laid) slide(this.lanes, this.laid, this.since, this.until);
    else queueMicrotask(() => this.drawLanes()); // uPlot lays a new drawing out in a microtask
  }

  drawPanel(panel) {
    panel.move(this.since, this.until, this.width);
  }

  /** Draw what comes into sight: those out of it wait until the figures rest. */
  seen(entries) {
    for (const { target, isIntersecting } of entries) {
      const panel = this.panels.find(({ node }) => node === target);
      if (!panel) continue;
      panel.inSight = isIntersecting;
      if (isIntersecting && panel.u) this.drawPanel(panel);
    }
  }

  get drawn() {
    return this.panels.filter(({ u }) => u);
  }

  /** Bucket width for one bucket a pixel. */
  wantedS() {
    return (this.until - this.since) / this.widthPx();
  }

  widthPx() {
    return Math.max(100, this.width - AXIS_PX - 10);
  }

  isCovered() {
    const { answer, asked } = this;
    if (!answer || this.since < asked.since || asked.until < this.until) return false;
    return answer.span_s === 0 || asked.wantedS <= 1.5 * this.wantedS();
  }

  /** Fetch twice the width shown, so that a small move finds its data there. */
  async ask() {
    if (!this.panels.length) return this.settle();
    this.abort?.abort();
    const { signal } = (this.abort = new AbortController());
    this.idle = false;
    const half = (this.until - this.since) / 2;
    const asked = { since: this.since - half, until: this.until + half, wantedS: this.wantedS() };
    const window = { since: iso(asked.since), until: iso(asked.until) };
    const quantities = [...new Set(this.panels.flatMap(({ spec }) => spec.lines.flatMap((line) => [line.quantity, line.sigma].filter(Boolean))))];
    try {
      const [answer, spans] = await Promise.all([
        this.values({ quantities: quantities.join(","), ...window, buckets: Math.round(2 * this.widthPx()) }, signal),
        getJson("/api/spans", { ...window, resolution: Math.max(1, Math.round(SPANS_PX * this.wantedS())) }, signal),
        this.chart,
      ]);
      this.answer = answer;
      this.asked = asked;
      this.spans = readSpans(spans);
      const shaded = shadedByKind(this.spans, this.point);
      for (const panel of this.panels) panel.show(answer, shaded);
      this.draw();
      this.tell(t("readout_hint"));
      this.settle();
    } catch (error) {
      if (error.name === "AbortError") return;
      this.readout.textContent = t("failed", { text: error.message });
      this.node.dataset.state = "failed";
    } finally {
      if (!signal.aborted) this.idle = true;
    }
  }

  /** An answer of /api/series, with or without what the ledger excludes. */
  values(parameters, signal) {
    return getJson("/api/series", { ...parameters, ...(this.withoutExcluded ? { without_excluded: 1 } : {}) }, signal);
  }

  /** All that need not follow each move: the marks, the address, the texts, the tables. */
  settle() {
    clearTimeout(this.settling);
    this.settling = setTimeout(() => {
      for (const panel of this.drawn) if (!panel.inSight) this.drawPanel(panel);
      this.drawLanes();
      history.replaceState(null, "", `#since=${iso(Math.round(this.since))}&until=${iso(Math.round(this.until))}${this.withoutExcluded ? "&excluded=out" : ""}`);
      this.showDays([timeText(this.since, "day"), timeText(this.until - 1, "day")]);
      for (const panel of this.panels) panel.describe();
      this.node.dataset.settled = `${iso(this.since)} ${iso(this.until)}`;
    }, SETTLE_MS);
    requestAnimationFrame(() => {
      if (this.isCovered() || !this.panels.length) this.node.dataset.state = "ready";
    });
  }

  /** The days that are shown; what is being typed in stays where they are the same as before. */
  showDays(days) {
    if (String(days) === String(this.days)) return;
    this.days = days;
    [this.from.value, this.to.value] = days;
  }

  renew() {
    for (const panel of this.panels) panel.redraw();
    this.settle();
    this.drawLanes();
  }

  redraw() {
    forgetColours();
    for (const panel of this.panels) panel.redraw();
  }

  resized() {
    if (this.width === this.panelBox.clientWidth) return;
    this.width = this.panelBox.clientWidth;
    for (const panel of this.panels) panel.resize(this.width);
    this.go(this.since, this.until);
  }

  // Gaps, flags, ledger, events as a row of buttons above the figures

  drawLanes() {
    const [first] = this.drawn;
    if (!first) return this.lanes.replaceChildren();
    const left = this.lanes.getBoundingClientRect().left;
    const place = first.u.over.getBoundingClientRect();
    const focused = document.activeElement?.dataset?.key;
    const tell = (text) => this.tell(text);
    this.laid = { since: this.since, until: this.until };
    this.lanes.replaceChildren(...laneRows(this.spans, this.since, this.until, place.left - left, place.width, tell, (span) => this.zoomTo(span)));
    const again = focused && this.lanes.querySelector(`[data-key="${focused}"]`);
    if (!again) return;
    again.tabIndex = 0;
    again.focus({ preventScroll: true });
  }

  zoomTo(span) {
    const margin = Math.max(0.5 * (span.end - span.start), 1800);
    this.go(span.start - margin, span.end + margin);
  }

  // The pointed-at time

  tell(text) {
    this.readout.textContent = text;
  }

  textAt(panel, index, seconds) {
    const spans = spansAt(this.spans, seconds, (panel.step ?? 60) / 2, panel.spanS / 2).map((span) => span.text);
    const time = timeText(seconds, panel.spanS ? "minute" : "second");
    return [time, panel.reading(index), ...new Set(spans)].filter(Boolean).join(" · ");
  }

  pointed(panel, u) {
    if (u.cursor.event === undefined && u.cursor.left < 0) return;
    const { left, idx } = u.cursor;
    if (left === undefined || left < 0 || (u.cursor.event?.target !== u.over && u.cursor.event)) return;
    const seconds = u.posToVal(left, "x");
    const index = idx !== null && Math.abs((panel.times[idx] ?? Infinity) - seconds) <= panel.step ? idx : null;
    this.index = idx ?? this.index;
    this.tell(this.textAt(panel, index, index === null ? seconds : panel.times[index]));
  }

  key(event) {
    const actions = {
      ArrowLeft: () => this.pan(-0.25), ArrowRight: () => this.pan(0.25),
      "+": () => this.zoom(0.5, 0.5), "=": () => this.zoom(0.5, 0.5), "-": () => this.zoom(2, 0.5),
      0: () => this.preset(null),
      Home: () => this.go(this.first, this.first + this.until - this.since),
      End: () => this.go(this.last - (this.until - this.since), this.last),
      ",": () => this.stepPoint(-1), ".": () => this.stepPoint(1),
      Enter: () => this.openPoint(),
    };
    const action = event.target === this.panelBox && !event.ctrlKey && !event.metaKey && !event.altKey && actions[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  stepPoint(by) {
    const [panel] = this.panels;
    if (!panel?.times.length) return;
    const [first, last] = panel.window();
    const inside = this.index !== null && this.index >= first && this.index < last;
    let index = inside ? this.index + by : by > 0 ? first : last - 1;
    while (index >= first && index < last && (panel.lines[0].mean[index] ?? null) === null) index += by;
    if (index < first || index >= last) return;
    this.index = index;
    const time = panel.times[index];
    for (const { u } of this.panels) u.setCursor({ left: u.valToPos(time, "x"), top: u.over.clientHeight / 2 }, false);
    const text = this.textAt(panel, index, time);
    this.tell(text);
    this.said.textContent = text;
  }

  openPoint() {
    const [panel] = this.panels;
    const value = this.index === null ? null : panel?.lines[0].mean[this.index];
    if (value !== null && value !== undefined) this.find(panel, 0, this.index, panel.lines[0].max[this.index]);
  }

  clicked(panel, x, y) {
    const { u } = panel;
    const reach = 12 / u.over.clientWidth * (this.until - this.since) + panel.step / 2;
    const seconds = u.posToVal(x, "x");
    let best = null;
    panel.times.forEach((time, index) => {
      if (Math.abs(time - seconds) > reach) return;
      const found = panel.nearest(index, y);
      const distance = found && Math.hypot(u.valToPos(time, "x") - x, found.distance);
      if (found && (!best || distance < best.distance)) best = { ...found, index, distance };
    });
    if (best) this.find(panel, best.k, best.index, best.value);
    else this.tell(this.textAt(panel, null, seconds) + ` · ${t("nothing_here")}`);
  }

  /** Open the slot behind a drawn value: in a bucket, the row nearest to the value that was meant. */
  async find(panel, k, index, value) {
    const line = panel.spec.lines[k];
    let time = panel.times[index];
    let spanS = panel.spanS;
    while (spanS > 0) {
      const inside = { since: iso(Math.floor(time - spanS / 2)), until: iso(Math.ceil(time + spanS / 2)) };
      const answer = await this.values({ quantities: line.quantity, ...inside, buckets: 500 });
      const { value: rows, min, max } = answer.series[line.quantity];
      const wanted = value / (line.factor ?? 1);
      const off = (n) => {
        const [low, high] = rows ? [rows[n], rows[n]] : [min[n], max[n]];
        return low === null || low === undefined ? Infinity : Math.max(low - wanted, wanted - high, 0);
      };
      let best = 0;
      answer.t.forEach((_, n) => { if (off(n) < off(best)) best = n; });
      if (!answer.t.length || answer.span_s >= spanS) break;
      spanS = answer.span_s;
      time = answer.t[best] + spanS / 2;
    }
    this.openSlot(iso(Math.round(time)));
  }
}
