// What canvases of demonstrations share: the report has this text inside its script, the page of `label` imports it.
export const FONT = "11px system-ui, sans-serif";
export const bytes = text => Uint8Array.from(atob(text), one => one.charCodeAt(0));
export const last = (sorted, value) => {  // the place of the last entry that is at most value
  let low = 0, high = sorted.length;
  while (low < high) { const middle = (low + high) >> 1; if (sorted[middle] <= value) low = middle + 1; else high = middle; }
  return low - 1;
};
export const bright = colour => {
  const [r, g, b] = [1, 3, 5].map(place => parseInt(colour.slice(place, place + 2), 16));
  return .299 * r + .587 * g + .114 * b > 140;
};
export function sharp(canvas, width, height) {  // a clear context with the pixels of the screen
  const ratio = devicePixelRatio || 1, context = canvas.getContext("2d");
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = FONT; context.textBaseline = "middle";
  return context;
}
export function axis(context, from, to, place, frequency) {  // ticks at round steps; `place` is the x of a step
  const width = place(to), rough = (to - from) / Math.max(2, (width - place(from)) / 100), power = 10 ** Math.floor(Math.log10(rough));
  const tick = Math.max(1, [1, 2, 5, 10].find(one => one * power >= rough) * power);
  for (let step = Math.ceil(from / tick) * tick; step <= to; step += tick) {
    const x = place(step);
    context.fillRect(x, 12, 1, 4);
    context.textAlign = x > width - 20 ? "right" : "center";
    context.fillText(frequency ? `${step} (${+(step / frequency).toFixed(2)} s)` : String(step), x, 5);
  }
  context.textAlign = "left"; context.fillText("step", 0, 6);
}
export class Numbers {  // observed numbers over time, bytes of each row
  constructor(data, steps) { Object.assign(this, data, { bytes: bytes(data.bytes), length: Math.ceil(steps / data.every) }); }
  share(row, step) { return this.bytes[row * this.length + Math.min(Math.floor(step / this.every), this.length - 1)] / 255; }
  value(row, step) { return this.low[row] + this.span[row] * this.share(row, step); }
}
export class Path {  // paths of a demonstration in space, in the colours of runs: [start, stop, colour]
  constructor(numbers, { view, paths, steps }, runs, width, height) {
    const ratio = devicePixelRatio || 1, canvas = new OffscreenCanvas(width * ratio, height * ratio), inside = canvas.getContext("2d");
    const point = (path, step) => view.map(weights => weights.reduce((sum, weight, axis) => sum + weight * numbers.value(path[axis], step), 0));
    const lines = paths.map(path => Array.from({ length: numbers.length }, (_, place) => point(path, place * numbers.every))), points = lines.flat();
    const [x0, x1, y0, y1] = [0, 1].flatMap(axis => [Math.min, Math.max].map(end => points.reduce((found, one) => end(found, one[axis]), points[0][axis])));
    const size = Math.min((width - 20) / (x1 - x0 || 1), (height - 20) / (y1 - y0 || 1));
    const put = ([x, y]) => [width / 2 + (x - (x0 + x1) / 2) * size, height / 2 + (y - (y0 + y1) / 2) * size];
    Object.assign(this, { canvas, width, height, at: step => paths.map(path => put(point(path, step))) });
    inside.scale(ratio, ratio); inside.lineWidth = 2; inside.lineJoin = "round";
    for (const [start, stop, colour] of runs) {
      const [first, end] = [start, stop].map(step => Math.min(Math.ceil(step / numbers.every), numbers.length));
      inside.strokeStyle = colour;
      lines.forEach((points, path) => {
        inside.setLineDash([[], [5, 2.5], [1.2, 2]][path % 3]); inside.beginPath();
        for (let place = Math.max(first - 1, 0); place < end; place++) inside.lineTo(...put(points[place]));
        inside.stroke();
      });
    }
  }
  draw(canvas, step, fill, stroke) {  // with a dot at a step
    const context = sharp(canvas, this.width, this.height);
    context.drawImage(this.canvas, 0, 0, this.width, this.height);
    context.lineWidth = 2; context.fillStyle = fill; context.strokeStyle = stroke;
    for (const place of this.at(step)) { context.beginPath(); context.arc(...place, 4.5, 0, 7); context.fill(); context.stroke(); }
  }
}
