// How a line is drawn. Of each bucket its whole extent, from its least to its greatest value, so that
// no peak is lost: as a column, which is filled many times faster than a zigzag is stroked.

export const SIGMAS = 2;
const WIDTH_PX = 1.25;
const JOINED = 1.6; // steps; where the next value is further away the line is broken

const colours = new Map();

/** A colour of style.css. */
export const colour = (name) => {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colours.get(name);
};

/** Read them again: the scheme has changed between light and dark. */
export const forgetColours = () => colours.clear();

/** Draw within the axes only. */
export const clipped = ({ ctx, bbox }, draw) => {
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  draw(ctx, bbox);
  ctx.restore();
};

const there = (value) => value !== null && value !== undefined;

/** The stretches without a break of a line, as [first, last] of its values. */
const runsOf = (times, mean, step, first, last) => {
  const runs = [];
  let begun = null;
  for (let n = first; n <= last; n += 1) {
    const joins = begun !== null && there(mean[n]) && times[n] - times[n - 1] <= JOINED * step;
    if (joins) continue;
    if (begun !== null) runs.push([begun, n - 1]);
    begun = there(mean[n]) ? n : null;
  }
  if (begun !== null) runs.push([begun, last]);
  return runs;
};

/** Functions from values to pixels of the canvas: uPlot's own, without its look-ups. */
const placesOf = ({ bbox, scales }) => {
  const across = bbox.width / (scales.x.max - scales.x.min);
  const up = bbox.height / (scales.y.max - scales.y.min);
  return [(time) => bbox.left + across * (time - scales.x.min), (value) => bbox.top + up * (scales.y.max - value), across];
};

/** Columns of whole pixels, so that the thinnest is as dark as the others. */
const columns = (path, x, y, half, { min, max }, times, [first, last]) => {
  const edges = [];
  for (let n = first; n <= last; n += 1) {
    const left = Math.round(x(times[n]) - half);
    const [high, low] = [y(max[n]), y(min[n])];
    const spare = Math.max(0, (WIDTH_PX * devicePixelRatio - (low - high)) / 2);
    edges.push([left, Math.max(left + 1, Math.round(x(times[n]) + half)), high - spare, low + spare]);
  }
  edges.forEach(([left, right, top], k) => {
    if (k) path.lineTo(left, top);
    else path.moveTo(left, top);
    path.lineTo(right, top);
  });
  for (const [left, right, , bottom] of edges.reverse()) {
    path.lineTo(right, bottom);
    path.lineTo(left, bottom);
  }
  path.closePath();
};

const polyline = (path, x, y, values, times, [first, last]) => {
  path.moveTo(x(times[first]) - (first === last ? 1 : 0), y(values[first]));
  for (let n = first + 1; n <= last; n += 1) path.lineTo(x(times[n]), y(values[n]));
  if (first === last) path.lineTo(x(times[first]) + 1, y(values[first]));
};

const band = (path, x, y, { min, max, sigma }, times, [first, last]) => {
  const wide = first === last ? 1 : 0;
  for (let n = first; n <= last; n += 1) {
    const top = y(max[n] + SIGMAS * (sigma[n] ?? 0));
    if (n === first) path.moveTo(x(times[n]) - wide, top);
    else path.lineTo(x(times[n]), top);
  }
  for (let n = last; n >= first; n -= 1) path.lineTo(x(times[n]) + wide, y(min[n] - SIGMAS * (sigma[n] ?? 0)));
  path.closePath();
};

/** Draw values `first` to `last` of a line, with the band of its uncertainty. */
export const drawLine = (u, line, hue, { times, step, spanS }, first, last) => {
  const [x, y, across] = placesOf(u);
  const runs = runsOf(times, line.mean, step, first, last);
  clipped(u, (ctx) => {
    const [shade, extents, through] = [new Path2D(), new Path2D(), new Path2D()];
    for (const run of runs) {
      if (line.sigma) band(shade, x, y, line, times, run);
      if (spanS > 0) columns(extents, x, y, (across * spanS) / 2, line, times, run);
      polyline(through, x, y, line.mean, times, run);
    }
    ctx.lineWidth = WIDTH_PX * devicePixelRatio;
    ctx.lineJoin = "bevel";
    ctx.fillStyle = colour(`--band-${hue}`);
    ctx.fill(shade);
    ctx.fillStyle = ctx.strokeStyle = colour(`--line-${hue}`);
    ctx.fill(extents);
    ctx.stroke(through);
  });
};
