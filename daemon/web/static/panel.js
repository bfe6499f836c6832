// One figure: lines of one unit over time. uPlot keeps scales, axes and cursor.

import { SIGMAS, clipped, colour, drawLine, drawReach } from "./lines.js";
import { duration, el, fixed, t, table, timeText, withSigma, zone } from "./page.js";

export const AXIS_PX = 62;
const TABLE_LINES = 200;

/** min, max, mean, sigma of a line as arrays, whether the answer has buckets or single rows. */
const readLine = (line, answer) => {
  const factor = line.factor ?? 1;
  const scaled = (values) =>
    factor === 1 || !values ? values : values.map((value) => (value === null ? null : factor * value));
  const series = answer.series[line.quantity] ?? {};
  const sigma = answer.series[line.sigma] ?? {};
  const value = scaled(series.value);
  return {
    min: value ?? scaled(series.min) ?? [],
    max: value ?? scaled(series.max) ?? [],
    mean: value ?? scaled(series.mean) ?? [],
    sigma: scaled(sigma.value ?? sigma.max),
  };
};

/** Where the line must not go on: a step much longer than the usual one. */
const usualStep = (times, spanS) => {
  if (spanS > 0) return spanS;
  const steps = [];
  for (let k = 1; k < Math.min(times.length, 400); k += 1) steps.push(times[k] - times[k - 1]);
  return steps.sort((a, b) => a - b)[steps.length >> 1] ?? 60;
};

export class Panel {
  /** Hooks: `started(panel)` once it can be pointed at, `pointed(panel, u)` whenever it is. */
  constructor(spec, hooks) {
    this.spec = spec;
    this.hooks = hooks;
    this.inSight = true;
    this.since = 0;
    this.until = 1;
    this.spans = new Map();
    this.times = [];
    this.marks = [];
    this.lines = spec.lines.map(() => ({ min: [], max: [], mean: [] }));
    this.plot = el("div", { class: "plot", role: "img", "aria-label": spec.title });
    this.keys = spec.lines.map((line, k) =>
      el("span", { class: "key" }, el("i", { class: `swatch line-${this.hue(k)}` }), line.label));
    this.details = el("details", { ontoggle: () => this.fillTable() },
      el("summary", {}, t("table_of", { title: spec.title })));
    this.node = el("figure", { class: "panel", "data-panel": spec.id },
      el("figcaption", {},
        el("span", { class: "title" }, `${spec.title}${spec.unit ? `, ${spec.unit}` : ""}`),
        this.keys,
        this.referenceKey = el("span", { class: "hint" }),
        spec.lines.some((line) => line.sigma) ? el("span", { class: "hint" }, t("band")) : null),
      this.plot, this.details);
  }

  hue(k) {
    return this.spec.lines[k].hue ?? k;
  }

  /** Make the drawing, with the values that are there; the node is in the page. */
  start(width) {
    const grid = { stroke: () => colour("--grid"), width: 1 };
    const axis = { stroke: () => colour("--ink-soft"), font: "12px system-ui, sans-serif", grid, ticks: grid };
    this.u = new uPlot({
      width, height: this.height,
      legend: { show: false },
      tzDate: (seconds) => uPlot.tzDate(new Date(1000 * seconds), zone()),
      cursor: { sync: { key: "record" }, drag: { x: false, y: false, setScale: false }, points: { size: 6 }, y: false },
      select: { show: true },
      scales: { x: { time: true, min: this.since, max: this.until }, y: { range: () => this.extent() } },
      axes: [
        { ...axis, space: 70, values: TIME_LABELS },
        { ...axis, size: AXIS_PX, space: 34, values: (_, ticks) => numbersOf(ticks) },
      ],
      series: [{}, ...this.spec.lines.map((line, k) => ({
        label: line.label,
        stroke: () => colour(`--line-${this.hue(k)}`),
        paths: () => null, // lines.js draws it
        points: { show: (u, index, first, last) => (last - first) * 7 < u.over.clientWidth, size: 4 },
      }))],
      hooks: {
        drawClear: [(u) => this.shade(u)], drawSeries: [(u, k) => this.drawLine(u, k - 1)],
        draw: [(u) => this.drawMarks(u)], setCursor: [(u) => this.hooks.pointed(this, u)],
      },
    }, this.data(), this.plot);
    this.u.over.classList.add("over");
    this.hooks.started(this);
  }

  get height() {
    return this.spec.height ?? 170;
  }

  data() {
    return [this.times, ...this.lines.map((line) => line.mean)];
  }

  resize(width) {
    this.u?.setSize({ width, height: this.height });
  }

  redraw() {
    this.u?.redraw(false, true);
  }

  /** Show an answer of /api/series, and spans as those of each kind. */
  show(answer, spans) {
    const half = answer.span_s / 2;
    this.spanS = answer.span_s;
    this.times = half ? answer.t.map((time) => time + half) : answer.t;
    this.step = usualStep(this.times, answer.span_s);
    this.lines = this.spec.lines.map((line) => readLine(line, answer));
    this.spans = spans;
    this.u?.setData(this.data(), false);
  }

  /** Take those marks of a reference that are of its quantities. */
  lay(name, marks) {
    const drawn = new Set(this.spec.lines.map(({ quantity }) => quantity));
    this.marks = marks.filter(({ quantity }) => drawn.has(quantity));
    this.referenceKey.textContent = this.marks.length ? t("reference_key", { name }) : "";
  }

  /** The values of the reference in the window: {time, value, half}. */
  markedInWindow() {
    return this.marks.flatMap(({ times_s, mm, expanded_mm }) => times_s.map((time, k) => ({ time, value: mm[k], half: expanded_mm[k] })))
      .filter(({ time }) => this.since <= time && time <= this.until);
  }

  /** A reference: a diamond at each value, a bar over its expanded uncertainty. */
  drawMarks(u) {
    const size = 5 * devicePixelRatio;
    clipped(u, (ctx) => {
      ctx.strokeStyle = colour("--ink");
      ctx.lineWidth = 1.5 * devicePixelRatio;
      ctx.beginPath();
      for (const { time, value, half } of this.markedInWindow()) {
        const [x, y] = [u.valToPos(time, "x", true), u.valToPos(value, "y", true)];
        ctx.moveTo(x, u.valToPos(value - half, "y", true));
        ctx.lineTo(x, u.valToPos(value + half, "y", true));
        ctx.moveTo(x - size, y);
        for (const [dx, dy] of [[0, -size], [size, 0], [0, size], [-size, 0]]) ctx.lineTo(x + dx, y + dy);
      }
      ctx.stroke();
    });
  }

  /** Show a part of it; the first time the drawing is made, in this width. */
  move(since, until, width) {
    this.since = since;
    this.until = until;
    if (this.u) this.u.batch(() => this.u.setScale("x", { min: since, max: until }));
    else this.start(width);
  }

  /** Indices of the values in the window, with one more to each side, or as many as asked. */
  window(more = this.step) {
    const at = (time) => {
      let low = 0;
      let high = this.times.length;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (this.times[middle] < time) low = middle + 1;
        else high = middle;
      }
      return low;
    };
    return [at(this.since - more), at(this.until + more)];
  }

  /** The least and greatest of a line in the window. */
  ends(line) {
    const [first, last] = this.window();
    let low = Infinity;
    let high = -Infinity;
    for (let k = first; k < last; k += 1) {
      if (line.mean[k] === null || line.mean[k] === undefined) continue;
      const sigma = SIGMAS * (line.sigma?.[k] ?? 0);
      if (line.min[k] - sigma < low) low = line.min[k] - sigma;
      if (line.max[k] + sigma > high) high = line.max[k] + sigma;
    }
    return [low, high];
  }

  extent() {
    const ends = this.lines.map((line) => this.ends(line));
    let low = Math.min(...ends.map(([low]) => low));
    let high = Math.max(...ends.map(([, high]) => high));
    for (const { value, half } of this.markedInWindow()) {
      [low, high] = [Math.min(low, value - half), Math.max(high, value + half)];
    }
    if (!Number.isFinite(low)) return [-1, 1];
    if (this.spec.zero) [low, high] = [Math.min(low, 0), Math.max(high, 0)];
    const pad = Math.max(0.06 * (high - low), this.spec.least ?? 1e-3);
    return [low - pad, high + pad];
  }

  drawLine(u, k) {
    const [first, last] = this.window();
    if (first >= last) return;
    const alone = !this.spec.mixed; // twice as much to draw: where lines cover one another
    if (k === 0 && !alone && this.spanS) this.lines.forEach((line, n) => drawReach(u, line, this.hue(n), this, first, last - 1));
    drawLine(u, this.lines[k], this.hue(k), this, first, last - 1, alone);
  }

  /** Gaps, flags and exclusions, behind the lines. */
  shade(u) {
    const strip = 6 * devicePixelRatio;
    const across = u.bbox.width / (this.until - this.since);
    const x = (time) => u.bbox.left + across * (Math.min(Math.max(time, this.since), this.until) - this.since);
    clipped(u, (ctx, bbox) => {
      for (const [kind, spans] of this.spans) {
        const half = kind === "datum" ? 0 : (this.step ?? 0) / 2;
        const high = spans[0].lane === "flag" ? strip : bbox.height;
        ctx.fillStyle = colour(`--span-${kind}`);
        for (const { start, end, isOpen } of spans) {
          if (end < this.since || start > this.until) continue;
          const left = x(start - half);
          ctx.fillRect(left, bbox.top + bbox.height - high, Math.max(x(end + (isOpen ? -half : half)) - left, devicePixelRatio), high);
        }
      }
    });
  }

  /** What stands at an index, as one text. */
  reading(index) {
    if (index === null || index === undefined || this.times[index] === undefined) return "";
    return this.lines.map((line, k) => {
      const { label } = this.spec.lines[k];
      const digits = this.spec.digits ?? 3;
      if (line.mean[index] === null || line.mean[index] === undefined) return `${label} –`;
      const unit = this.spec.unit ? ` ${this.spec.unit}` : "";
      const sigma = line.sigma?.[index];
      const value = sigma ? withSigma(line.mean[index], sigma) : fixed(line.mean[index], digits);
      const spread = line.min[index] === line.max[index]
        ? "" : ` (${t("between", { min: fixed(line.min[index], digits), max: fixed(line.max[index], digits) })})`;
      return `${label} ${value}${unit}${spread}`;
    }).join(", ");
  }

  /** The line and the value nearest to a place in the drawing: {k, value} or null. */
  nearest(index, y) {
    let best = null;
    this.lines.forEach((line, k) => {
      if (line.mean[index] === null || line.mean[index] === undefined) return;
      const value = Math.min(Math.max(this.u.posToVal(y, "y"), line.min[index]), line.max[index]);
      const distance = Math.abs(this.u.valToPos(value, "y") - y);
      if (!best || distance < best.distance) best = { k, value, distance };
    });
    return best;
  }

  /** Say in words what is drawn, and renew the table if it is open. */
  describe() {
    const lines = this.spec.lines.map((line, k) => {
      const [low, high] = this.ends({ ...this.lines[k], sigma: null });
      const { unit = "", digits = 3 } = this.spec;
      return Number.isFinite(low)
        ? t("line_says", { label: line.label, min: fixed(low, digits), max: fixed(high, digits), unit })
        : t("line_empty", { label: line.label });
    });
    const marked = this.markedInWindow().length;
    if (marked) lines.push(t("reference_says", { count: marked }));
    const span = t("until_time", { start: timeText(this.since), end: timeText(this.until) });
    this.plot.setAttribute("aria-label", t("panel_says", { title: `${this.spec.title}, ${span}`, lines: lines.join("; ") }));
    this.fillTable();
  }

  fillTable() {
    if (!this.details.open) return;
    const [first, last] = this.window(0);
    const every = Math.max(1, Math.ceil((last - first) / TABLE_LINES));
    const { digits = 3 } = this.spec;
    const rows = [];
    for (let k = first; k < last; k += every) {
      rows.push([timeText(this.times[k], "second"), ...this.lines.flatMap((line) => this.cells(line, k, every, digits))]);
    }
    const single = this.spanS === 0 && every === 1;
    const columns = [t("time"), ...this.spec.lines.flatMap(({ label }) =>
      single ? [label] : [`${label}, ${t("minimum")}`, `${label}, ${t("maximum")}`])];
    const note = single
      ? t("table_note_rows", { count: rows.length })
      : t("table_note", { count: rows.length, seconds: duration(every * this.step) });
    this.details.replaceChildren(this.details.firstElementChild, el("p", { class: "hint" }, note),
      table(t("table_of", { title: this.spec.title }), columns, rows));
  }

  cells(line, k, every, digits) {
    if (every === 1 && this.spanS === 0) return [fixed(line.mean[k], digits)];
    const there = (values) => values.slice(k, k + every).filter((value) => value !== null && value !== undefined);
    const [low, high] = [there(line.min), there(line.max)];
    return [fixed(low.length ? Math.min(...low) : null, digits), fixed(high.length ? Math.max(...high) : null, digits)];
  }
}

const numbersOf = (ticks) => {
  const step = ticks.length > 1 ? Math.abs(ticks[1] - ticks[0]) : 1;
  const digits = Math.min(6, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  return ticks.map((tick) => fixed(tick, digits));
};

// As in uPlot's own list: tick distance, the label, and what is added at a new year, day, ...
const DAY = "\n{YYYY}-{MM}-{DD}";
const TIME_LABELS = [
  [365 * 86400, "{YYYY}", null, null, null, null, null, null, 1],
  [28 * 86400, "{MMM}", "\n{YYYY}", null, null, null, null, null, 1],
  [86400, "{MM}-{DD}", "\n{YYYY}", null, null, null, null, null, 1],
  [3600, "{HH}:{mm}", DAY, null, DAY, null, null, null, 1],
  [60, "{HH}:{mm}", DAY, null, DAY, null, null, null, 1],
  [1, "{HH}:{mm}:{ss}", DAY, null, DAY, null, null, null, 1],
  [0.001, "{HH}:{mm}:{ss}.{fff}", DAY, null, DAY, null, null, null, 1],
];
