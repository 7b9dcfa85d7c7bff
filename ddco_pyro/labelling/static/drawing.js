// What canvases share: colours of the page, segments, and a demonstration's picture or path at a step.
export const FONT = "11px system-ui, sans-serif", CONTROL = "#9a9a9a";
export const bytes = text => Uint8Array.from(atob(text), one => one.charCodeAt(0));
export const percent = share => `${(100 * share).toFixed(1)} %`;
export const last = (sorted, value) => {  // the place of the last entry that is at most value
  let low = 0, high = sorted.length;
  while (low < high) { const middle = (low + high) >> 1; if (sorted[middle] <= value) low = middle + 1; else high = middle; }
  return low - 1;
};
export const bright = colour => {
  const [r, g, b] = [1, 3, 5].map(place => parseInt(colour.slice(place, place + 2), 16));
  return .299 * r + .587 * g + .114 * b > 140;
};
export const coloured = (colours, option) => option ? colours[option - 1] : CONTROL;
export const within = (segments, step) => segments.find(one => one.start <= step && step < one.stop);

export const looks = {};
const scheme = matchMedia("(prefers-color-scheme: dark)");
export function restyle() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ink", "soft", "paper", "panel", "line", "accent"]) looks[name] = style.getPropertyValue(`--${name}`).trim();
}
export const onScheme = call => scheme.addEventListener("change", () => { restyle(); call(); });
restyle();

export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

export function sharp(canvas, width, height) {
  const ratio = devicePixelRatio || 1, context = canvas.getContext("2d");
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = FONT; context.textBaseline = "middle";
  return context;
}

function hatch(context, left, top, width, height) {
  context.save();
  context.beginPath(); context.rect(left, top, width, height); context.clip();
  context.fillStyle = looks.panel; context.fillRect(left, top, width, height);
  context.strokeStyle = looks.soft; context.lineWidth = 1; context.beginPath();
  for (let x = left - height; x < left + width; x += 6) { context.moveTo(x, top + height); context.lineTo(x + height, top); }
  context.stroke(); context.restore();
}

// Segments in a row of a canvas; `place` is the x of a step, `heights` the probability of each step times 255, `edge` the end of the row.
export function row(context, segments, { place, edge, top, height, colours, names, heights }) {
  for (const { start, stop, option, said } of segments) {
    const left = Math.max(place(start), place.least ?? 0), right = Math.min(place(stop), edge), colour = coloured(colours, option);
    if (right <= left) continue;
    if (said === "open") hatch(context, left, top, right - left, height);
    else {
      context.fillStyle = colour;
      context.globalAlpha = heights && said === "proposed" ? .3 : 1;
      context.fillRect(left, top, right - left, height);
      context.globalAlpha = 1;
      if (heights && said === "proposed") {
        const each = place(1) - place(0), wide = Math.max(1, each), bottom = top + height;
        context.beginPath(); context.moveTo(left, bottom);
        for (let x = Math.max(place(start), left - wide); x < right - .01; x += wide) {
          const step = Math.min(Math.max(start, Math.floor((x - place(0)) / each + .001)), stop - 1), y = bottom - height * heights[step] / 255;
          context.lineTo(Math.max(x, left), y); context.lineTo(Math.min(x + wide, right), y);
        }
        context.lineTo(right, bottom); context.fill();
      }
    }
    if (right - left > 6) { context.fillStyle = looks.paper; context.fillRect(right - 1, top, 1, height); }
    if (!names || right - left < 14) continue;
    const name = said === "open" ? "open" : names(option), wide = context.measureText(name).width, short = wide < right - left - 6 ? name : String(option);
    if (context.measureText(short).width >= right - left - 4) continue;
    const dark = said !== "open" && !bright(colour), x = (left + right) / 2, y = top + height / 2 + 1;
    context.textAlign = "center"; context.lineWidth = 2.5;
    context.strokeStyle = said === "open" ? looks.panel : dark ? "#000a" : "#fffa";
    context.fillStyle = said === "open" ? looks.ink : dark ? "#fff" : "#000";
    context.strokeText(short, x, y); context.fillText(short, x, y);
    context.textAlign = "left";
  }
}

export class Numbers {  // observed numbers, bytes of each over time
  constructor(data, steps) { Object.assign(this, data); this.bytes = bytes(data.bytes); this.length = Math.ceil(steps / data.every); }
  share(row, step) { return this.bytes[row * this.length + Math.min(Math.floor(step / this.every), this.length - 1)] / 255; }
  value(row, step) { return this.low[row] + this.span[row] * this.share(row, step); }
}

export class Look {  // a demonstration at a step: its picture, and its path in the colours of the segments
  constructor(root, width, height) {
    Object.assign(this, { width, height, wanted: -1, shown: -1, step: 0 });
    this.picture = element("img", { alt: "", hidden: true, height });
    this.path = element("canvas", { hidden: true });
    Object.assign(this.path.style, { width: `${width}px`, height: `${height}px` });
    root.replaceChildren(this.picture, this.path);
    this.picture.onload = this.picture.onerror = () => { this.loading = false; this.load(); };
  }
  show(demo, segments, colours) {
    const { view, paths, numbers } = demo;
    Object.assign(this, { demo, shown: -1, drawn: null });
    this.picture.hidden = !demo.pictures; this.path.hidden = !(view && paths?.length);
    this.picture.alt = `Picture of ${demo.name} at the cursor`;
    if (!this.path.hidden) {
      const values = numbers.decoded ?? new Numbers(numbers, demo.steps), ratio = devicePixelRatio || 1;
      const point = (path, step) => view.map(weights => weights.reduce((sum, weight, axis) => sum + weight * values.value(path[axis], step), 0));
      const every = Math.max(1, Math.floor(demo.steps / 1000)), canvas = new OffscreenCanvas(this.width * ratio, this.height * ratio), inside = canvas.getContext("2d");
      const steps = Array.from({ length: Math.ceil(demo.steps / every) }, (_, n) => n * every), lines = paths.map(path => steps.map(step => point(path, step)));
      let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
      for (const [x, y] of lines.flat()) { x0 = Math.min(x0, x); x1 = Math.max(x1, x); y0 = Math.min(y0, y); y1 = Math.max(y1, y); }
      const size = Math.min((this.width - 20) / (x1 - x0 || 1), (this.height - 20) / (y1 - y0 || 1));
      const put = ([x, y]) => [this.width / 2 + (x - (x0 + x1) / 2) * size, this.height / 2 + (y - (y0 + y1) / 2) * size];
      inside.scale(ratio, ratio); inside.lineWidth = 2.5; inside.lineJoin = "round";
      for (const { start, stop, option, said } of segments) lines.forEach((points, n) => {
        inside.strokeStyle = coloured(colours, said === "open" ? 0 : option); inside.setLineDash([[], [5, 2.5], [1.2, 2]][n % 3]); inside.beginPath();
        for (let at = Math.floor(start / every); at <= Math.min(Math.floor(stop / every), points.length - 1); at++) inside.lineTo(...put(points[at]));
        inside.stroke();
      });
      this.drawn = { canvas, put: (path, step) => put(point(path, step)) };
    }
    this.at(Math.min(this.step, demo.steps - 1));
  }
  at(step) {
    this.step = step;
    if (this.drawn) {
      const context = sharp(this.path, this.width, this.height);
      context.drawImage(this.drawn.canvas, 0, 0, this.width, this.height);
      context.lineWidth = 2; context.fillStyle = looks.paper; context.strokeStyle = looks.ink;
      for (const path of this.demo.paths) { context.beginPath(); context.arc(...this.drawn.put(path, step), 5, 0, 7); context.fill(); context.stroke(); }
    }
    this.load();
  }
  load() {  // one picture at a time, so that playing shows as many as come
    if (!this.demo?.pictures || this.loading || this.shown === this.step) return;
    this.loading = true; this.shown = this.step;
    this.picture.src = `demo/${this.demo.index}/picture/${this.step}`;
  }
}
