// How a line is drawn. Of each bucket its whole extent, from its least to its greatest value, so that
// no peak is lost. All is drawn as many small shapes: a browser without a graphics card takes ten times
// as long for one path of a thousand corners.

export const SIGMAS = 2;
const WIDTH_PX = 1.25;
const PIECE = 8; // values in one path
const JOINED = 1.6; // steps; where the next value is further away the line is broken
const TALL_PX = 4; // an extent that could hide another line's
const THROUGH = 0.4; // how much of an extent covers what lies below it

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

const columns = { left: [], right: [], top: [], bottom: [] };

/** Where the buckets of a run lie, and how far they reach: columns of whole pixels, so that the thinnest is
 * as dark as the others, and from each to the next one without a break. In `columns`, which all runs share. */
const placeColumns = (x, y, half, { min, max }, times, first, last) => {
  const count = last - first + 1;
  if (columns.left.length < count) {
    for (const name of Object.keys(columns)) columns[name] = new Float64Array(2 * count);
  }
  const { left, right, top, bottom } = columns;
  const least = WIDTH_PX * devicePixelRatio;
  for (let k = 0; k < count; k += 1) {
    const n = first + k;
    left[k] = Math.round(x(times[n]) - half);
    right[k] = Math.max(left[k] + 1, Math.round(x(times[n]) + half));
    const [high, low] = [y(max[n]), y(min[n])];
    const spare = Math.max(0, (least - (low - high)) / 2);
    top[k] = high - spare;
    bottom[k] = low + spare;
    if (k && top[k] > bottom[k - 1]) bottom[k - 1] = top[k];
    else if (k && bottom[k] < top[k - 1]) top[k - 1] = bottom[k];
  }
  return columns;
};

const drawColumns = (ctx, x, y, half, line, times, [first, last], [ink, shade]) => {
  const { left, right, top, bottom } = placeColumns(x, y, half, line, times, first, last);
  if (line.sigma) {
    ctx.fillStyle = shade;
    let drawn = -Infinity; // shades that overlap would be darker there
    for (let n = first; n <= last; n += 1) {
      const [k, reach] = [n - first, SIGMAS * (line.sigma[n] ?? 0)];
      const [high, from] = [y(line.max[n] + reach), Math.max(left[k], drawn)];
      ctx.fillRect(from, high, right[k] - from, y(line.min[n] - reach) - high);
      drawn = Math.max(drawn, right[k]);
    }
  }
  ctx.fillStyle = ink;
  for (let k = 0; k <= last - first; k += 1) ctx.fillRect(left[k], top[k], right[k] - left[k], bottom[k] - top[k]);
};

const isTall = (line, n, y) => y(line.min[n]) - y(line.max[n]) > TALL_PX * devicePixelRatio;

/** A line whose tall columns are their means alone. */
const withoutTall = (line, y) => {
  const ends = (values) => values.map((value, n) => (isTall(line, n, y) ? line.mean[n] : value));
  return { ...line, min: ends(line.min), max: ends(line.max) };
};

/** Draw how far the tall columns of a line reach so that other lines show through: before all lines. */
export const drawReach = (u, line, hue, { times, spanS }, first, last) => {
  const [x, y, across] = placesOf(u);
  const half = (across * spanS) / 2;
  clipped(u, (ctx) => {
    ctx.fillStyle = colour(`--line-${hue}`);
    ctx.globalAlpha = THROUGH;
    for (let n = first; n <= last; n += 1) {
      if (!there(line.mean[n]) || !isTall(line, n, y)) continue;
      const left = Math.round(x(times[n]) - half);
      const width = Math.max(1, Math.round(x(times[n]) + half) - left);
      ctx.fillRect(left, y(line.max[n]), width, y(line.min[n]) - y(line.max[n]));
    }
  });
};

/** Call for pieces of a run, each of which begins with the last value of the one before. */
const inPieces = ([first, last], size, draw) => {
  for (let from = first; from < last || from === first; from += size) draw(from, Math.min(last, from + size));
};

const drawRows = (ctx, x, y, { mean, sigma }, times, run, [ink, shade]) => {
  const wide = run[0] === run[1] ? 1 : 0; // a value that stands alone
  if (sigma) {
    const half = (n) => SIGMAS * (sigma[n] ?? 0);
    ctx.fillStyle = shade;
    inPieces(run, PIECE, (from, to) => {
      ctx.beginPath();
      if (wide) ctx.rect(x(times[from]) - 1, y(mean[from] + half(from)), 2, y(mean[from] - half(from)) - y(mean[from] + half(from)));
      for (let n = from; n <= to; n += 1) ctx.lineTo(Math.round(x(times[n])), y(mean[n] + half(n)));
      for (let n = to; n >= from; n -= 1) ctx.lineTo(Math.round(x(times[n])), y(mean[n] - half(n)));
      ctx.fill();
    });
  }
  ctx.strokeStyle = ink;
  inPieces(run, PIECE, (from, to) => {
    ctx.beginPath();
    ctx.moveTo(x(times[from]) - wide, y(mean[from]));
    for (let n = from + 1; n <= to; n += 1) ctx.lineTo(x(times[n]), y(mean[n]));
    if (wide) ctx.lineTo(x(times[from]) + 1, y(mean[from]));
    ctx.stroke();
  });
};

/** Draw values `first` to `last` of a line, with the band of its uncertainty; beside others without
 * what `drawReach` draws of it. */
export const drawLine = (u, line, hue, { times, step, spanS }, first, last, alone) => {
  const [x, y, across] = placesOf(u);
  const inks = [colour(`--line-${hue}`), colour(`--band-${hue}`)];
  clipped(u, (ctx) => {
    ctx.lineWidth = WIDTH_PX * devicePixelRatio;
    ctx.lineJoin = "bevel";
    const shown = alone || !spanS ? line : withoutTall(line, y);
    for (const run of runsOf(times, line.mean, step, first, last)) {
      if (spanS > 0) drawColumns(ctx, x, y, (across * spanS) / 2, shown, times, run, inks);
      else drawRows(ctx, x, y, shown, times, run, inks);
    }
  });
};
