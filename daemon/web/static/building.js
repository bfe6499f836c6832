// How far the page has read the record: until it has read all, long spans are not whole.

import { el, getJson, percent, t } from "./page.js";

const POLL_MS = 3000;

/** Say it in a node until all is read; `grown` is called whenever more of the record is there. */
export const followBuilding = async (node, share, grown) => {
  let now = share;
  while (now !== null) {
    const text = t("building", { percent: percent(now) });
    node.replaceChildren(text, " ", el("progress", { value: now, "aria-label": t("building_short") }));
    node.hidden = false;
    await new Promise((done) => { setTimeout(done, POLL_MS); });
    const before = now;
    now = await getJson("/api/site").then(({ building }) => building, () => before);
    if (now !== before) grown();
  }
  node.hidden = true;
};
