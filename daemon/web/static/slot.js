import { at } from "./page.js";
import { showSlot, slotKeys } from "./slot_view.js";

const node = document.getElementById("slot");
const go = (slot) => {
  history.replaceState(null, "", at(`/slot/${encodeURIComponent(slot)}`));
  showSlot(node, slot, go);
};
document.addEventListener("keydown", slotKeys(node));
showSlot(node, node.dataset.slot, go);
