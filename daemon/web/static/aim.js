// What both cameras see, for whoever aims and focuses them: large figures, from arm's length.

import { el, fixed, getJson, percent, pointName, svg, t, timeText, epoch } from "./page.js";

const POLL_MS = 1000;
const stateLine = document.getElementById("aim-state");
const box = document.getElementById("aim");
const awakeButton = document.getElementById("awake");
const best = {};
const shown = {};
const pixelsButton = document.getElementById("pixels");
const showsPixels = () => pixelsButton.getAttribute("aria-pressed") === "true";

const histogram = (counts) => {
  const top = Math.max(1, ...counts);
  const drawn = svg("svg", { class: "histogram", viewBox: `0 0 ${counts.length} 32`, preserveAspectRatio: "none", role: "img", "aria-label": t("histogram") },
    counts.map((count, k) => {
      const tall = 32 * Math.sqrt(count / top);
      return svg("rect", { x: k, y: 32 - tall, width: 1, height: tall });
    }));
  return [drawn, el("p", { class: "hint ends" }, el("span", {}, t("dark")), el("span", {}, t("histogram_hint")), el("span", {}, t("bright")))];
};

const meter = (role, focus) => {
  best[role] = Math.max(best[role] ?? 0, focus);
  const share = best[role] > 0 ? focus / best[role] : 0;
  return el("div", { class: "focus" },
    el("span", {}, t("focus")),
    el("meter", { min: 0, max: 1, value: share, "aria-label": t("focus") }),
    el("strong", {}, t("focus_says", { now: fixed(focus, 4), best: fixed(best[role], 4), percent: percent(share) })));
};

const facts = (camera) => {
  const { room_px: room } = camera;
  const entries = [
    [t("found"), camera.found],
    ...(camera.further ?? []).map(({ name, role, text }) => [pointName(name, role), text]),
    room ? [t("room"), t("room_says", Object.fromEntries(Object.entries(room).map(([side, px]) => [side, fixed(px, 0)])))] : null,
    [t("brightest"), t("of_range", { percent: percent(camera.brightest) })],
    [t("saturated"), t("of_pixels", { percent: percent(camera.saturated) })],
    camera.blur_px ? [t("blur"), `${fixed(camera.blur_px, 2)} px`] : null,
    camera.exposure_us ? [t("exposure"), `${fixed(camera.exposure_us, 0)} µs, ${fixed(camera.gain_db, 1)} dB`] : null,
    camera.temperature_c ? [t("temperature"), `${fixed(camera.temperature_c, 1)} °C`] : null,
  ];
  return el("dl", {}, entries.filter(Boolean).flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, value ?? "–")]));
};

/** The same element from look to look, so that nothing flickers. */
const picture = (key, source, attributes) => {
  const image = shown[key] ??= el("img", attributes);
  if (image.getAttribute("src") !== source) image.src = source;
  return image;
};

/** The whole frame, and its own pixels about the target: only these show how sharp it is. */
const pictures = (role, { frame, detail, width_px: width, height_px: height }) => {
  const camera = t(`frame_${role}`);
  return [
    frame ? picture(role, frame, { alt: camera, width, height }) : null,
    detail && showsPixels() ? picture(`${role} detail`, detail, { class: "pixels", alt: t("pixels_alt", { camera }) }) : null,
  ];
};

const show = (role, camera) => {
  const hints = [...(camera.hints ?? []), ...(camera.problems ?? [])];
  return el("section", { class: "camera", "data-camera": role, "aria-labelledby": `${role}-heading` },
    el("h2", { id: `${role}-heading` }, t(`frame_${role}`)),
    hints.length ? el("ul", { class: "hints" }, hints.map((hint) => el("li", {}, hint))) : null,
    meter(role, camera.focus), pictures(role, camera), histogram(camera.histogram ?? []), facts(camera));
};

const poll = async () => {
  try {
    const look = await getJson("/api/aim");
    const time = timeText(epoch(look.time), "second");
    stateLine.textContent = [t(look.live ? "live" : "stored", { time }), look.trouble].filter(Boolean).join(" · ");
    const cameras = Object.entries(look.cameras ?? {}).filter(([, camera]) => camera);
    box.replaceChildren(...cameras.map(([role, camera]) => show(role, camera)));
    box.dataset.state = "ready";
  } catch (error) {
    stateLine.textContent = t("failed", { text: error.message });
    box.dataset.state = "failed";
  } finally {
    setTimeout(poll, POLL_MS);
  }
};

pixelsButton.addEventListener("click", () => pixelsButton.setAttribute("aria-pressed", !showsPixels()));
document.getElementById("forget").addEventListener("click", () => {
  for (const role of Object.keys(best)) delete best[role];
});

// The screen of a phone stays on; the browser lets go of it when the page is hidden.

let lock = null;
const wanted = () => awakeButton.getAttribute("aria-pressed") === "true";
const hold = async () => {
  try {
    lock = await navigator.wakeLock.request("screen");
  } catch {
    awakeButton.setAttribute("aria-pressed", "false"); // the battery is low, or the page not in front
  }
};
if (navigator.wakeLock) {
  awakeButton.addEventListener("click", () => {
    awakeButton.setAttribute("aria-pressed", !wanted());
    if (wanted()) hold();
    else lock?.release();
  });
  document.addEventListener("visibilitychange", () => { if (!document.hidden && wanted()) hold(); });
} else awakeButton.hidden = true;

poll();
