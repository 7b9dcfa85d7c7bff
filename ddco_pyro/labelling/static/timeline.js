// One demonstration over time: levels, boundaries, numbers; the cursor, and what is dragged or painted.
import { Numbers, axis, bytes, last, sharp } from "./canvas.js";
import { coloured, element, looks, row } from "./drawing.js";

const GUTTER = 108, AXIS = 16, LANE = 18, MAIN = 34, BAND = 14, PLOT = 24, LEAST = 10, NEAR = 6;

export class Timeline {
  constructor(root, calls) {  // calls: seek(step), split(step), drop({boundary, to}), menu(x, y), level(number), other(other, x, y)
    Object.assign(this, { root, calls, from: 0, to: 1, cursor: 0, preview: null, asked: false, stale: true });
    this.canvas = element("canvas"); this.line = element("i", { className: "cursor" }); this.ghost = element("i", { className: "ghost", hidden: true });
    root.append(this.canvas, this.ghost, this.line);
    new ResizeObserver(() => this.redraw()).observe(root);
    root.addEventListener("pointerdown", event => this.down(event));
    root.addEventListener("pointermove", event => this.point(event));
    root.addEventListener("pointerup", event => this.up(event));
    root.addEventListener("pointercancel", () => { this.drag = null; this.hold(null); });
    root.addEventListener("dblclick", event => { if (event.offsetX >= GUTTER) calls.split(this.step(event)); });
    root.addEventListener("contextmenu", event => {
      event.preventDefault();
      const box = root.getBoundingClientRect(), keyed = event.button !== 2;
      if (!keyed) calls.seek(this.step(event));
      calls.menu(keyed ? box.left + this.x(this.cursor) : event.clientX, keyed ? box.top + this.lanes : event.clientY);
    });
    root.addEventListener("wheel", event => {
      if (event.ctrlKey || event.metaKey) this.zoom(1.2 ** Math.sign(event.deltaY), this.step(event));
      else if (event.shiftKey) this.pan(this.from + (event.deltaX || event.deltaY) / this.each);
      else return;
      event.preventDefault();
    }, { passive: false });
  }
  show(demo, state, chosen) {
    if (this.demo?.index !== demo.index) [this.from, this.to] = [0, demo.steps];
    Object.assign(this, { demo, state });
    demo.heights ??= bytes(demo.probability);
    for (const one of demo.boundaries) one.heights ??= bytes(one.density);
    if (demo.numbers) demo.numbers.decoded ??= new Numbers(demo.numbers, demo.steps);
    let top = AXIS;
    this.rows = chosen; this.bands = [];
    const add = (lane, name, call) => { this.bands.push({ lane, name, top, call }); top += LANE + 3; };
    const levels = above => demo.upper.filter(one => one.above === above).forEach(one => add(one, one.name, () => this.calls.level(one.level)));
    levels(true);
    for (const other of demo.others) add(other, other.annotator, (x, y) => this.calls.other(other, x, y));
    this.main = top; top += MAIN + BAND + 4;
    levels(false);
    this.lanes = top;
    this.height = this.lanes + this.rows.length * PLOT;
    this.root.style.height = `${this.height}px`;
    this.redraw();
  }
  get each() { return (this.root.clientWidth - GUTTER) / (this.to - this.from); }
  x(step) { return GUTTER + (step - this.from) * this.each; }
  step(event) {
    const at = Math.floor(this.from + (event.clientX - this.root.getBoundingClientRect().left - GUTTER) / this.each);
    return Math.min(Math.max(at, 0), this.demo.steps - 1);
  }
  seek(step) {
    this.cursor = step;
    if (step < this.from || step >= this.to) this.pan(step - (this.to - this.from) / 4);
    this.refresh();
  }
  hold(preview) { this.preview = preview; this.refresh(); }  // {boundary, to}, or {start, stop, option} while painting
  moved(boundary, to) {  // a boundary stays between its neighbours
    const after = this.demo.segments.findIndex(one => one.start === boundary), [{ start }, { stop }] = this.demo.segments.slice(after - 1);
    this.hold({ boundary, to: Math.min(Math.max(to, start + 1), stop - 1) });
    return this.preview;
  }
  zoom(factor, centre = this.cursor) {
    const wide = Math.min(Math.max((this.to - this.from) * factor, LEAST), this.demo.steps), share = (centre + .5 - this.from) / (this.to - this.from);
    this.to = this.from + wide;
    this.pan(centre + .5 - Math.min(Math.max(share, 0), 1) * wide);
  }
  all() { [this.from, this.to] = [0, this.demo.steps]; this.redraw(); }
  pan(start) {
    const wide = this.to - this.from;
    this.from = Math.min(Math.max(start, 0), this.demo.steps - wide); this.to = this.from + wide;
    this.redraw();
  }
  near(event) {  // the boundary that is pointed at
    const box = this.root.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    if (y < this.main || y > this.main + MAIN + BAND || x < GUTTER) return null;
    return this.demo.boundaries.map(one => [Math.abs(this.x(one.step) - x), one.step]).filter(([far]) => far <= NEAR).sort((a, b) => a[0] - b[0])[0]?.[1] ?? null;
  }
  down(event) {
    if (event.button || !this.demo) return;
    const y = event.clientY - this.root.getBoundingClientRect().top, band = this.bands.find(({ top }) => y >= top && y < top + LANE);
    if (band) { event.preventDefault(); event.stopPropagation(); band.call(event.clientX, event.clientY); return; }
    this.root.setPointerCapture(event.pointerId);
    const boundary = this.near(event);
    this.drag = { boundary };
    if (boundary === null) this.calls.seek(this.step(event));
  }
  point(event) {
    if (!this.demo) return;
    if (!this.drag) this.root.style.cursor = this.near(event) === null ? "" : "ew-resize";
    else if (this.drag.boundary === null) this.calls.seek(this.step(event));
    else this.moved(this.drag.boundary, Math.round(this.from + (event.clientX - this.root.getBoundingClientRect().left - GUTTER) / this.each));
  }
  up(event) {
    const { drag, preview } = this;
    this.drag = null;
    if (drag && preview) this.calls.drop(preview);
    else if (drag) this.calls.seek(this.step(event));  // a click that moves nothing
  }
  redraw() { this.stale = true; this.refresh(); }
  refresh() { if (!this.asked) { this.asked = true; requestAnimationFrame(() => { this.asked = false; this.frame(); }); } }
  frame() {
    if (!this.demo || !this.root.clientWidth) return;
    if (this.stale) { this.stale = false; this.draw(); }
    const x = this.x(this.cursor + .5), held = this.preview;
    this.line.style.transform = `translateX(${Math.min(Math.max(x, GUTTER), this.root.clientWidth) - .5}px)`;
    this.ghost.hidden = !held;
    if (!held) return;
    const [start, stop] = held.boundary === undefined ? [held.start, held.stop] : [held.boundary, held.to].sort((a, b) => a - b);
    const left = Math.max(this.x(start), GUTTER), top = this.main, colours = this.state.colours;
    const after = this.demo.segments[last(this.demo.segments.map(one => one.start), held.boundary - (held.to > held.boundary ? 1 : 0))];
    const colour = coloured(colours, held.option ?? after?.option ?? 0);
    Object.assign(this.ghost.style, { left: `${left}px`, width: `${Math.max(this.x(stop) - left, 1)}px`, top: `${top}px`, height: `${MAIN}px`, background: colour });
  }
  draw() {
    const { demo, state } = this, width = this.root.clientWidth, context = sharp(this.canvas, width, this.height), place = step => this.x(step);
    place.least = GUTTER;
    const edge = Math.min(this.x(demo.steps), width), label = (text, y) => { context.fillStyle = looks.soft; context.fillText(text, 0, y, GUTTER - 8); };
    context.fillStyle = looks.soft;
    axis(context, this.from, this.to, place, state.frequency);
    for (const { lane, name, top } of this.bands) {
      label(name, top + LANE / 2);
      row(context, lane.segments, { place, edge, top, height: LANE, colours: lane.colours, names: option => option ? lane.names[option - 1] : "control" });
    }
    let top = this.main;
    label(demo.others.length ? state.annotator : state.level, top + MAIN / 2);
    const names = option => option ? state.names[option - 1] : "control";
    row(context, demo.segments, { place, edge, top, height: MAIN, colours: state.colours, names, heights: demo.heights });
    top += MAIN;
    label("boundaries", top + BAND / 2 + 2);
    context.save();
    context.beginPath(); context.rect(GUTTER, 0, width - GUTTER, this.height); context.clip();
    for (const { step, low, high, said, heights } of demo.boundaries) {
      const x = this.x(step), foot = Math.max(this.each, 3), left = this.x(low) - foot, right = this.x(high) + foot;
      if (right < GUTTER || left > width) continue;
      context.fillStyle = said ? looks.ink : looks.accent;
      context.beginPath();
      if (said) { context.moveTo(x - 4, top + 9); context.lineTo(x, top + 2); context.lineTo(x + 4, top + 9); }
      else {  // the posterior density of the boundary's step
        context.moveTo(left, top + BAND);
        heights.forEach((height, place) => context.lineTo(this.x(low + place), top + BAND - (BAND - 1) * height / 255));
        context.lineTo(right, top + BAND);
      }
      context.fill();
    }
    context.restore();
    this.rows.forEach((number, place) => this.plot(context, number, demo.numbers.names[number], this.lanes + place * PLOT, width, label));
  }
  plot(context, number, name, top, width, label) {
    const { numbers, steps } = this.demo, values = numbers.decoded, wide = Math.min(width, this.x(steps)), pixel = Math.max(this.each, 1) / this.each;
    label(name, top + PLOT / 2);
    context.strokeStyle = looks.line; context.lineWidth = 1; context.beginPath(); context.moveTo(GUTTER, top + PLOT - .5); context.lineTo(wide, top + PLOT - .5); context.stroke();
    context.strokeStyle = looks.ink; context.beginPath();
    for (let at = this.from; at < this.to; at += pixel) {
      const step = Math.min(Math.floor(at), steps - 1);
      context.lineTo(this.x(at), top + PLOT - 3 - (PLOT - 6) * values.share(number, step));
    }
    context.stroke();
  }
}
