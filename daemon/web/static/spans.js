// Spans of the record: gaps, flags, ledger, events. What they say, and where they lie.

import { el, epoch, plain, reasonsText, t, timeText } from "./page.js";

const LANES = ["gap", "flag", "ledger", "event"];
const OPEN = new Set(["gap", "ledger"]); // their end is the first slot that is not in them
const MOST = 60; // what a keyboard can step through
const NEAR_PX = 9;
const MARK_PX = 7; // as in style.css

/** A stretch of time with its text, which is made when it is first wanted: of most it never is. */
class Span {
  #say;
  #text = null;

  constructor(lane, kind, start, end, say, point) {
    Object.assign(this, { lane, kind, start, end, point, isOpen: OPEN.has(lane) });
    this.#say = say;
  }

  get text() {
    return (this.#text ??= this.#say());
  }
}

/** The spans of an answer of /api/spans, as they begin. */
export const readSpans = (answer) => {
  const found = [];
  const add = (lane, kind, start, end, say, point = null) => {
    const from = epoch(start);
    found.push(new Span(lane, kind, from, Math.max(from, epoch(end) ?? from), say, point));
  };
  for (const gap of answer.gaps ?? []) {
    const slots = () => (gap.slots ? `, ${t("slots", { count: gap.slots })}` : "");
    add("gap", "gap", gap.start, gap.end, () => `${t("gap")}: ${plain(gap.cause)}${slots()}`);
  }
  for (const run of answer.flags ?? []) {
    add("flag", `flag-${run.flag}`, run.start, run.end, () => `${t(`flag_${run.flag}`)}: ${reasonsText(run.reasons)}`);
  }
  for (const entry of answer.ledger ?? []) {
    const by = [entry.author, entry.point && `${t("point")}: ${entry.point}`].filter(Boolean).join("; ");
    add("ledger", entry.kind === "exclude" ? "excluded" : "remark", entry.start, entry.end,
      () => `${t(`kind_${entry.kind}`)}: ${entry.text}${by && ` (${by})`}`, entry.point);
  }
  for (const datum of answer.datum ?? []) {
    add("event", "datum", datum.at, datum.at, () => `${t("calibration")} ${datum.calibration}`);
  }
  for (const event of answer.events ?? []) {
    add("event", "event", event.time ?? event.at, event.time ?? event.at, () => [plain(event.kind), event.detail].filter(Boolean).join(": "));
  }
  return found.sort((a, b) => a.start - b.start);
};

/** Spans that are shaded in the figures of a point, by kind: a drawing takes one colour after the other. */
export const shadedByKind = (spans, point) => {
  const found = new Map();
  for (const span of spans) {
    if (span.kind === "event" || (span.point ?? point) !== point) continue;
    if (!found.has(span.kind)) found.set(span.kind, []);
    found.get(span.kind).push(span);
  }
  return found;
};

/** What holds at a row, or in a bucket that reaches `half` seconds to each side; moments and runs of
 * rows are met from `reach` seconds away. */
export const spansAt = (spans, seconds, reach = 0, half = 0) =>
  spans.filter(({ start, end, isOpen }) => (isOpen
    ? start <= seconds + half && seconds - half < end
    : start - reach <= seconds && seconds <= end + reach));

export const spanText = (span) =>
  span.end > span.start
    ? `${span.text} (${t("until_time", { start: timeText(span.start), end: timeText(span.end) })})`
    : `${span.text} (${timeText(span.start)})`;

const GRAVER = ["remark", "event", "datum", "gap", "flag-3", "excluded", "flag-4", "flag-9"];
const graver = (a, b) => (GRAVER.indexOf(a) < GRAVER.indexOf(b) ? b : a);

/** Up to three different texts of spans, of the first ones. */
const textsOf = (spans) => {
  const texts = new Set();
  for (const { text } of spans) {
    texts.add(text);
    if (texts.size === 3) break;
  }
  return [...texts];
};

/** Spans of one lane in a window, those closer than `near` seconds put together: first those of one
 * kind; while there are too many, those of any kind that begin within `near`, shown as the graver.
 * Moments in a row never become a bar: an hour of them would look like one that lasted so long. */
export const together = (spans, lane, since, until, near, mixed = false) => {
  const groups = [];
  for (const span of spans) {
    if (span.lane !== lane || span.end < since || span.start > until) continue;
    const last = groups.at(-1);
    const byStart = mixed || lane === "event";
    const joins = last && (mixed || last.kind === span.kind) && span.start - (byStart ? last.start : last.end) < near;
    if (joins) {
      last.end = Math.max(last.end, span.end);
      last.spans.push(span);
      last.kind = graver(last.kind, span.kind);
    } else groups.push({ lane, kind: span.kind, start: span.start, end: span.end, spans: [span] });
  }
  if (groups.length > MOST) return together(spans, lane, since, until, 2 * near + 1, true);
  return groups.map(({ spans: within, ...group }) => {
    const [count, text] = [within.length, textsOf(within).join("; ")];
    return { ...group, count, text: count === 1 ? text : t("several", { count, text }) };
  });
};

/** Arrow keys go from mark to mark, so that a row of sixty is one stop of the Tab key. */
const stepMarks = (event) => {
  const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  const marks = [...event.currentTarget.querySelectorAll(".mark")];
  const next = by && marks[marks.indexOf(event.target) + by];
  if (!next) return;
  event.preventDefault();
  event.target.tabIndex = -1;
  next.tabIndex = 0;
  next.focus();
};

/** A row of buttons for each lane, above the figures: at `leftPx`, `widthPx` wide. */
export const laneRows = (spans, since, until, leftPx, widthPx, tell, zoomTo) => {
  const percent = (time) => (100 * (Math.min(Math.max(time, since), until) - since)) / (until - since);
  const mark = (lane, span, k) => {
    const text = spanText(span);
    const [left, right] = [percent(span.start), percent(span.end)];
    return el("button", {
      type: "button", tabindex: k ? -1 : 0, class: `mark mark-${span.kind}`, "aria-label": text, title: text, "data-key": `${lane}${span.start}`,
      style: { left: `min(${left}%, 100% - ${MARK_PX}px)`, width: `${right - left}%` },
      onfocus: () => tell(text), onmouseenter: () => tell(text), onclick: () => zoomTo(span),
    });
  };
  return LANES.map((lane) => {
    const marks = together(spans, lane, since, until, (NEAR_PX * (until - since)) / widthPx);
    const name = t(`lane_${lane}`);
    return el("div", { class: "lane", role: "group", "aria-label": name, onkeydown: stepMarks }, el("span", { class: "lane-name" }, name),
      el("div", { class: "track", style: { marginLeft: `${leftPx}px`, width: `${widthPx}px` } },
        el("div", { class: "marks" }, marks.map((span, k) => mark(lane, span, k)))));
  });
};

/** Move the marks that were made for one window to where they belong in another one. */
export const slide = (lanes, made, since, until) => {
  const share = (seconds) => seconds / (until - since);
  const transform = `translateX(${100 * share(made.since - since)}%) scaleX(${share(made.until - made.since)})`;
  for (const marks of lanes.querySelectorAll(".marks")) marks.style.transform = transform;
};
