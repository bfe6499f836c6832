// What every page uses: texts, elements, numbers, times, tables, answers of the server.

const strings = JSON.parse(document.getElementById("strings").textContent);

/** A text of strings/*.json, with {names} filled in. */
export const t = (key, values = {}) =>
  ((values.count === 1 && strings[`${key}_one`]) || (strings[key] ?? key)).replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");

const SVG = "http://www.w3.org/2000/svg";

const filled = (node, attributes, children) => {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(node.style, value); // as an attribute the page's own policy forbids it
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) node.setAttribute(name, value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
};

/** An element; attributes named on... are listeners. Texts are never read as markup. */
export const el = (tag, attributes = {}, ...children) =>
  filled(document.createElement(tag), attributes, children);

export const svg = (tag, attributes = {}, ...children) =>
  filled(document.createElementNS(SVG, tag), attributes, children);

/** A number with a fixed number of digits; a dash for what is missing. */
export const fixed = (value, digits = 3) =>
  value === null || value === undefined || !Number.isFinite(value)
    ? "–"
    : value.toFixed(digits).replace(/^-(?=.*[1-9])/, "−").replace(/^-/, "");

/** Digits after the point that show two of a sigma's own. */
export const digitsOf = (sigma) =>
  sigma > 0 ? Math.min(5, Math.max(1, 1 - Math.floor(Math.log10(sigma)))) : 3;

export const withSigma = (value, sigma) => {
  const digits = digitsOf(sigma);
  return sigma > 0 ? `${fixed(value, digits)}\u00a0±\u00a0${fixed(sigma, digits)}` : fixed(value, digits);
};

/** What a point of the bridge, or a fixed plate, is called. */
export const pointName = (name, role) =>
  role === "fixed" ? t("fixed_point", { name }) : name === "main" ? t("main_point") : name;

/** A word of the record in plain English: camera_lost. */
export const plain = (word) => `${word ?? ""}`.replaceAll("_", " ");

/** Reasons of a row as one text. */
export const reasonsText = (reasons) => (Array.isArray(reasons) ? reasons.map(plain).join(" + ") : plain(reasons));

export const percent = (share) =>
  share === null || share === undefined ? "–" : `${share === 1 ? 100 : share > 0.99 ? Math.min(99.9, 100 * share).toFixed(1) : (100 * share).toFixed(share > 0 && share < 0.1 ? 1 : 0)} %`;

const UNITS = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]];

/** A duration in its largest fitting unit. */
export const duration = (seconds) => {
  if (seconds === null || seconds === undefined) return "–";
  const [size, unit] = UNITS.find(([size]) => seconds >= 2 * size) ?? [1, "s"];
  return `${Math.round(seconds / size)} ${unit}`;
};

// Times

const root = document.documentElement;
const zoneSelect = document.getElementById("zone");

const remembered = (key, otherwise) => {
  try {
    return localStorage.getItem(key) ?? otherwise;
  } catch {
    return otherwise; // a browser that keeps nothing
  }
};
export const remember = (key, value) => {
  try {
    localStorage.setItem(key, value);
  } catch {
    // kept for this page only
  }
};
export const recall = remembered;

/** The time zone that times are shown in. */
export const zone = () => {
  const choice = zoneSelect.value;
  if (choice === "utc") return "UTC";
  if (choice === "local") return Intl.DateTimeFormat().resolvedOptions().timeZone;
  return root.dataset.timezone;
};

const formats = new Map();
const format = (seconds, style) => {
  const key = style + zone();
  if (!formats.has(key)) {
    const parts = { year: "numeric", month: "2-digit", day: "2-digit" };
    if (style !== "day") Object.assign(parts, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
    if (style === "second") parts.second = "2-digit";
    formats.set(key, new Intl.DateTimeFormat("sv-SE", { ...parts, timeZone: zone() }));
  }
  return formats.get(key).format(1000 * seconds);
};

/** Epoch seconds as 2026-03-01 12:00 in the chosen zone; style: day, minute, second. */
export const timeText = (seconds, style = "minute") =>
  seconds === null || seconds === undefined || Number.isNaN(seconds) ? "–" : format(seconds, style);

/** Epoch seconds of a day's midnight in the chosen zone; a day is 2026-03-01. */
export const midnight = (day) => {
  const utc = Date.parse(`${day}T00:00:00Z`) / 1000;
  const ahead = (seconds) => Date.parse(`${format(seconds, "second").replace(" ", "T")}Z`) / 1000 - seconds;
  return utc - ahead(utc - ahead(utc)); // what the clock is ahead by then, not at midnight UTC
};

/** Epoch seconds of an ISO text, or of a number. */
export const epoch = (time) =>
  time === null || time === undefined ? null : typeof time === "number" ? time : Date.parse(time) / 1000;

/** An ISO text with Z, to the second. */
export const iso = (seconds) => new Date(1000 * seconds).toISOString().replace(/\.\d+Z$/, "Z");

/** A <time> that follows the choice of zone. */
export const timeElement = (time, style = "minute") => {
  if (time === null || time === undefined) return el("span", {}, "–");
  const seconds = epoch(time);
  return el("time", { datetime: iso(seconds), "data-style": style }, timeText(seconds, style));
};

const zoneChanged = () => {
  document.getElementById("zone-name").textContent = t("zone_now", { zone: zone() });
  for (const node of document.querySelectorAll("time[datetime]")) {
    node.textContent = timeText(Date.parse(node.dateTime) / 1000, node.dataset.style);
  }
  document.dispatchEvent(new Event("zone"));
};
zoneSelect.value = remembered("zone", "site");
if (!zoneSelect.value) zoneSelect.value = zoneSelect.querySelector("[value=site]") ? "site" : "utc";
zoneSelect.addEventListener("change", () => {
  remember("zone", zoneSelect.value);
  zoneChanged();
});
zoneChanged();

// The server

/** An address of this site's page: in the page of many sites each is below its own place. */
export const at = (path) => `${root.dataset.root}${path}`;

/** The answer to a GET; throws an Error with the server's own line. */
export const getJson = async (path, parameters = {}, signal = undefined) => {
  const query = new URLSearchParams(parameters).toString();
  const answer = await fetch(at(query ? `${path}?${query}` : path), { signal, headers: { Accept: "application/json" } });
  if (answer.ok) return answer.json();
  let text = `${answer.status} ${answer.statusText}`;
  try {
    text = (await answer.json()).error ?? text;
  } catch {
    // not JSON: the status says enough
  }
  throw new Error(text);
};

/** Fill a part of the page; an error is said in its place. Sets data-state: loading, ready, failed. */
export const fill = async (node, make) => {
  node.dataset.state = "loading";
  try {
    await make(node);
    node.dataset.state = "ready";
  } catch (error) {
    if (error.name === "AbortError") return;
    node.replaceChildren(el("p", { class: "notice", role: "alert" }, t("failed", { text: error.message })));
    node.dataset.state = "failed";
  }
};

/** Replace what stands below a heading. */
export const below = (section, ...children) => {
  const heading = section.querySelector("h2");
  section.replaceChildren(...[heading, ...children].filter(Boolean));
};

/** A table: columns are texts, cells are texts or nodes. On a phone it scrolls sideways by itself; with
 * the class `stack` each row is a list of its cells there, each with the name of its column. */
export const table = (caption, columns, rows, attributes = {}) =>
  el("div", { class: "scroll", tabindex: 0, role: "group", "aria-label": caption },
    el("table", attributes,
      el("caption", { class: "unseen" }, caption),
      el("thead", {}, el("tr", {}, columns.map((text) => el("th", { scope: "col" }, text)))),
      el("tbody", {}, rows.map((cells) => el("tr", {}, cells.map((cell, k) =>
        el(k === 0 ? "th" : "td", { "data-column": columns[k], ...(k === 0 ? { scope: "row" } : {}) }, cell ?? "–")))))));

export const STACK = { class: "stack" };

/** A flag as its word, with its colour. */
export const flagElement = (flag) => el("span", { class: `flag flag-${flag}` }, `${flag} ${t(`flag_${flag}`)}`);
