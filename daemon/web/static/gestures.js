// Mouse, wheel, fingers on a drawing, as calls of move, zoom, select and click.

const CLICK_PX = 4;

/**
 * Listen to the area over a drawing. Shares and factors: `zoom(factor, share)` about a place of the
 * width, `pan(share)`, `pick(from, to)` of a selection (`show(from, to)` while it is drawn; null ends
 * it), `click(x, y)` in px.
 */
export const listen = (area, { zoom, pan, show, pick, click }) => {
  const fingers = new Map();
  let begun = null;
  const share = (x) => (x - area.getBoundingClientRect().left) / area.clientWidth;
  const apart = () => {
    const [a, b] = [...fingers.values()];
    return { distance: Math.max(20, Math.abs(a.x - b.x)), middle: share((a.x + b.x) / 2) };
  };

  area.addEventListener("wheel", (event) => {
    event.preventDefault();
    const unit = event.deltaMode === 1 ? 30 : 1;
    const sideways = event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY);
    if (sideways) pan(((event.deltaX || event.deltaY) * unit) / area.clientWidth);
    else zoom(Math.exp(0.002 * unit * Math.max(-300, Math.min(300, event.deltaY))), share(event.clientX));
  }, { passive: false });

  area.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button > 1) return;
    area.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const moves = event.pointerType !== "mouse" || event.shiftKey || event.button === 1;
    begun = fingers.size === 1
      ? { x: event.clientX, y: event.clientY, moves, far: false } : { ...begun, far: true, pinch: apart() };
  });

  area.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before || !begun) return;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (Math.hypot(event.clientX - begun.x, event.clientY - begun.y) > CLICK_PX) begun.far = true;
    if (begun.pinch && fingers.size > 1) {
      const now = apart();
      zoom(begun.pinch.distance / now.distance, now.middle);
      pan(begun.pinch.middle - now.middle);
      begun.pinch = now;
    } else if (begun.far && begun.moves) pan((before.x - event.clientX) / area.clientWidth);
    else if (begun.far) show(share(begun.x), share(event.clientX));
  });

  const over = (event) => {
    if (!fingers.delete(event.pointerId) || fingers.size || !begun) return;
    const { far, moves, x } = begun;
    begun = null;
    if (!moves) show(null);
    if (event.type === "pointercancel") return;
    const box = area.getBoundingClientRect();
    if (!far) click(event.clientX - box.left, event.clientY - box.top);
    else if (!moves) pick(share(x), share(event.clientX));
  };
  area.addEventListener("pointerup", over);
  area.addEventListener("pointercancel", over);
};
