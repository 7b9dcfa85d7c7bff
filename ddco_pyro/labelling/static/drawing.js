// The look of the page's canvases: its colours, segments, and a demonstration's picture or path at a step.
import { Numbers, Path, bright } from "./canvas.js";

export const CONTROL = "#9a9a9a", AGAIN = 1000;
export const percent = share => `${(100 * share).toFixed(1)} %`;
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
  for (const { start, stop, option, source } of segments) {
    const left = Math.max(place(start), place.least ?? 0), right = Math.min(place(stop), edge), colour = coloured(colours, option);
    if (right <= left) continue;
    if (source === "open") hatch(context, left, top, right - left, height);
    else {
      context.fillStyle = colour;
      context.globalAlpha = heights && source === "proposed" ? .3 : 1;
      context.fillRect(left, top, right - left, height);
      context.globalAlpha = 1;
      if (heights && source === "proposed") {
        const each = place(1) - place(0), wide = Math.max(1, each), bottom = top + height;
        context.beginPath(); context.moveTo(left, bottom);
        for (let x = Math.max(place(start), left - wide); x < right - .01; x += wide) {
          const step = Math.min(Math.max(start, Math.floor((x - place(0)) / each + .001)), stop - 1), y = bottom - height * heights[step] / 255;
          context.lineTo(Math.max(x, left), y); context.lineTo(Math.min(x + wide, right), y);
        }
        context.lineTo(right, bottom); context.fill();
      }
    }
    if (heights && ["given", "accepted"].includes(source)) { const thick = source === "given" ? 4 : 2; context.fillStyle = looks.ink; context.fillRect(left, top + height - thick, right - left, thick); }
    if (right - left > 6) { context.fillStyle = looks.paper; context.fillRect(right - 1, top, 1, height); }
    if (!names || right - left < 14) continue;
    const name = source === "open" ? "open" : names(option), wide = context.measureText(name).width, short = wide < right - left - 6 ? name : String(option);
    if (context.measureText(short).width >= right - left - 4) continue;
    const dark = source !== "open" && !bright(colour), x = (left + right) / 2, y = top + height / 2 + 1;
    context.textAlign = "center"; context.lineWidth = 2.5;
    context.strokeStyle = source === "open" ? looks.panel : dark ? "#000a" : "#fffa";
    context.fillStyle = source === "open" ? looks.ink : dark ? "#fff" : "#000";
    context.strokeText(short, x, y); context.fillText(short, x, y);
    context.textAlign = "left";
  }
}

export class Look {  // a demonstration at a step: its pictures, and its path in the colours of the segments
  constructor(root, width, height) {
    Object.assign(this, { root, width, height, cameras: [], step: 0 });
    this.path = element("canvas", { hidden: true });
    Object.assign(this.path.style, { width: `${width}px`, height: `${height}px` });
    root.replaceChildren(this.path);
  }
  camera(name, number) {
    const picture = element("img"), made = { picture, number, shown: "", box: element("figure", {}, picture, element("figcaption", { textContent: name })) };
    picture.onload = () => { made.loading = false; this.load(made); };
    picture.onerror = () => setTimeout(() => { made.loading = false; made.shown = ""; this.load(made); }, AGAIN);
    this.path.before(made.box);
    return made;
  }
  show(demo, segments, colours, place) {
    const { view, paths, numbers, cameras } = demo;
    Object.assign(this, { demo, place, drawn: null });
    if (String(cameras) !== this.names) { this.cameras.forEach(({ box }) => box.remove()); this.cameras = cameras.map((name, number) => this.camera(name, number)); this.names = String(cameras); }
    this.root.classList.toggle("several", cameras.length > 1);
    this.cameras.forEach(({ picture }, number) => { picture.alt = `Picture ${cameras[number]} of ${demo.name} at the cursor`; });
    this.path.hidden = !(view && paths?.length);
    if (!this.path.hidden) {
      const runs = segments.map(({ start, stop, option, source }) => [start, stop, coloured(colours, source === "open" ? 0 : option)]);
      this.drawn = new Path(numbers.decoded ?? new Numbers(numbers, demo.steps), demo, runs, this.width, this.height);
    }
    this.at(Math.min(this.step, demo.steps - 1));
  }
  at(step) {
    this.step = step;
    this.drawn?.draw(this.path, step, looks.paper, looks.ink);
    this.cameras.forEach(one => this.load(one));
  }
  load(camera) {  // one picture of a camera at a time, so that playing shows as many as come
    const wanted = `${this.place}/demo/${this.demo.index}/picture/${camera.number}/${this.step}`;
    if (camera.loading || camera.shown === wanted) return;
    camera.loading = true; camera.shown = wanted;
    camera.picture.src = wanted;
  }
}
