// One figure: lines of one unit over time, drawn by uPlot. Of each bucket the whole extent is drawn,
// from its least to its greatest value, so that no peak is lost.

import { duration, el, fixed, t, table, timeText, withSigma, zone } from "./page.js";

export const SIGMAS = 2;
export const AXIS_PX = 62;
const TABLE_LINES = 200;
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

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
    count: series.count,
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
  constructor(spec) {
    this.spec = spec;
    this.since = 0;
    this.until = 1;
    this.spans = [];
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

  /** Make the drawing; the node is in the page. */
  start(hooks) {
    const size = this.size();
    const grid = { stroke: () => colour("--grid"), width: 1 };
    const axis = { stroke: () => colour("--ink-soft"), font: "12px system-ui, sans-serif", grid, ticks: grid };
    this.u = new uPlot({
      ...size,
      legend: { show: false },
      tzDate: (seconds) => uPlot.tzDate(new Date(1000 * seconds), zone()),
      cursor: { sync: { key: "record" }, drag: { x: false, y: false, setScale: false }, points: { size: 6 }, y: false },
      select: { show: true },
      scales: { x: { time: true }, y: { range: () => this.extent() } },
      axes: [
        { ...axis, space: 70, values: TIME_LABELS },
        { ...axis, size: AXIS_PX, space: 34, values: (_, ticks) => numbersOf(ticks) },
      ],
      series: [{}, ...this.spec.lines.map((line, k) => ({
        label: line.label,
        stroke: () => colour(`--line-${this.hue(k)}`),
        fill: () => colour(`--band-${this.hue(k)}`),
        width: 1.25,
        paths: (u, _, first, last) => this.path(u, k, first, last),
        points: { show: (u, index, first, last) => (last - first) * 7 < u.over.clientWidth, size: 4 },
      }))],
      hooks: { drawClear: [(u) => this.shade(u)], draw: [(u) => this.drawMarks(u)], ...hooks },
    }, [[], ...this.spec.lines.map(() => [])], this.plot);
    this.u.over.classList.add("over");
  }

  size() {
    return { width: Math.max(240, this.plot.clientWidth), height: this.spec.height ?? 170 };
  }

  resize() {
    this.u.setSize(this.size());
  }

  redraw() {
    this.u.redraw(false, true);
  }

  /** Show an answer of /api/series. */
  show(answer, spans) {
    const half = answer.span_s / 2;
    this.spanS = answer.span_s;
    this.times = half ? answer.t.map((time) => time + half) : answer.t;
    this.step = usualStep(this.times, answer.span_s);
    this.lines = this.spec.lines.map((line) => readLine(line, answer));
    this.spans = spans;
    this.u.setData([this.times, ...this.lines.map((line) => line.mean)], false);
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
    const { ctx, bbox } = u;
    const size = 5 * devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.strokeStyle = ctx.fillStyle = colour("--ink");
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
    ctx.restore();
  }

  /** Show a part of it. */
  move(since, until) {
    this.since = since;
    this.until = until;
    this.u.batch(() => {
      this.u.setScale("x", { min: since, max: until });
    });
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

  /** The extents as one stroke; the band of the uncertainty as a fill. */
  path(u, k, first, last) {
    const { min, max, mean, sigma } = this.lines[k];
    const stroke = new Path2D();
    const fill = sigma ? new Path2D() : null;
    const x = (time) => u.valToPos(time, "x", true);
    const y = (value) => u.valToPos(value, "y", true);
    let run = [];
    const close = () => {
      if (run.length === 1) {
        stroke.moveTo(run[0].x - 1, run[0].high);
        stroke.lineTo(run[0].x + 1, run[0].high);
      }
      if (fill && run.length) {
        const wide = run.length === 1 ? 1 : 0;
        run.forEach((at, n) => (n ? fill.lineTo(at.x, at.top) : fill.moveTo(at.x - wide, at.top)));
        if (wide) fill.lineTo(run[0].x + wide, run[0].top);
        for (const at of run.toReversed()) fill.lineTo(at.x + wide, at.bottom);
        if (wide) fill.lineTo(run[0].x - wide, run[0].bottom);
        fill.closePath();
      }
      run = [];
    };
    const end = Math.min(last + 1, this.times.length - 1);
    for (let n = Math.max(0, first - 1); n <= end; n += 1) {
      if (mean[n] === null || mean[n] === undefined) {
        close();
        continue;
      }
      if (run.length && this.times[n] - this.times[n - 1] > 1.6 * this.step) close();
      const half = SIGMAS * (sigma?.[n] ?? 0);
      const at = { x: x(this.times[n]), high: y(max[n]), low: y(min[n]), top: y(max[n] + half), bottom: y(min[n] - half) };
      if (run.length) stroke.lineTo(at.x, at.high);
      else stroke.moveTo(at.x, at.high);
      if (at.low !== at.high) stroke.lineTo(at.x, at.low);
      run.push(at);
    }
    close();
    return { stroke, fill, clip: null, band: null, gaps: null, flags: 0 };
  }

  /** Gaps, flags and exclusions, behind the lines. */
  shade(u) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    const strip = 6 * devicePixelRatio;
    const colours = {};
    for (const span of this.spans) {
      if (span.end < this.since || span.start > this.until || span.kind === "event") continue;
      const half = span.kind === "datum" ? 0 : (this.step ?? 0) / 2;
      const left = u.valToPos(Math.max(span.start - half, this.since), "x", true);
      const right = u.valToPos(Math.min(span.end + half, this.until), "x", true);
      ctx.fillStyle = colours[span.kind] ??= colour(`--span-${span.kind}`);
      const flag = span.lane === "flag";
      ctx.fillRect(left, flag ? bbox.top + bbox.height - strip : bbox.top, Math.max(right - left, devicePixelRatio),
        flag ? strip : bbox.height);
    }
    ctx.restore();
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
