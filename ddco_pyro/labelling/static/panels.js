// What stands beside the time line: the list of demonstrations, options, the readout, and what is alike.
import { last, sharp } from "./canvas.js";
import { coloured, element, looks, percent, row, within } from "./drawing.js";

const swatch = colour => { const made = element("span", { className: "swatch" }); made.style.background = colour; return made; };

export const optionName = (state, option, source) => source === "open" ? "open" : option ? state.names[option - 1] ?? `option ${option}` : "control";

export class List {  // all demonstrations, the most informative first, each with its segments
  constructor(root, find, sort, only, count, open) {
    Object.assign(this, { root, find, sort, only, count, open, rows: [], order: [] });
    find.oninput = only.onchange = () => this.filter();
    sort.onchange = () => { this.order = []; this.show(this.state, this.active, false); };
    find.onkeydown = event => {
      const first = this.shown()[0];
      if (event.key === "Escape") { find.value = ""; this.filter(); root.focus(); }
      else if (event.key === "Enter" && first !== undefined) { find.value = ""; this.filter(); root.focus(); open(first); }
      else if (event.key === "ArrowDown") root.focus();  // to walk through what is found
      else return;
      event.preventDefault(); event.stopPropagation();
    };
    root.onclick = event => { const row = event.target.closest("[role=option]"); if (row) open(Number(row.dataset.index)); };
    root.onkeydown = event => {
      const shown = this.shown(), at = shown.indexOf(this.active), step = { ArrowDown: 1, ArrowUp: -1, PageDown: 10, PageUp: -10, Home: -Infinity, End: Infinity }[event.key];
      if (step === undefined || !shown.length) return;
      event.preventDefault(); event.stopPropagation();
      open(shown[Math.min(Math.max(at + step, 0), shown.length - 1)]);
    };
    new ResizeObserver(() => this.draw()).observe(root);
  }
  shown() { return this.order.filter(index => !this.rows[index].row.hidden); }
  filter() {
    const words = this.find.value.trim().toLowerCase(), { demos, annotator } = this.state;
    const kinds = {
      all: () => true, left: one => !one.accepted && !one.marks.exclude, mine: one => !one.people.length || one.people.includes(annotator),
      two: one => one.accepted && one.done_by.length, flag: one => one.marks.flag, note: one => one.marks.note, exclude: one => one.marks.exclude,
    };
    this.rows.forEach(({ row }, index) => { row.hidden = !(`${demos[index].name} ${demos[index].task}`.toLowerCase().includes(words) && kinds[this.only.value](demos[index])); });
    this.draw();
  }
  show(state, active, keep) {  // keep: the order stays until another demonstration is opened
    if (!this.rows.length) this.rows = state.demos.map((demo, index) => {
      const [name, mark, reason, canvas] = [element("strong", { textContent: demo.name }), element("span", { className: "mark" }), element("small"), element("canvas")];
      const row = element("div", { id: `demo-${index}` }, name, mark, reason, canvas);
      row.setAttribute("role", "option"); row.dataset.index = index;
      return { row, name, mark, reason, canvas };
    });
    if (!keep || !this.order.length) { this.order = this.sorted(state); this.root.replaceChildren(...this.order.map(index => this.rows[index].row)); }
    state.demos.forEach((demo, index) => {
      const { row, mark, reason } = this.rows[index], changed = demo.changed && index !== active;
      row.setAttribute("aria-selected", index === active);
      mark.textContent = [demo.marks.exclude && "✗ excluded", demo.marks.flag && "⚑", demo.marks.note && "✎", demo.accepted && "✓ accepted", changed && "● changed", demo.held_out && "held out"].filter(Boolean).join("  ");
      reason.textContent = demo.accepted ? `${demo.steps} steps` : demo.reason;
    });
    this.state = state;
    this.count.textContent = `${state.demos.filter(one => one.accepted).length} of ${state.demos.length} accepted`;
    this.root.setAttribute("aria-activedescendant", `demo-${active}`);
    if (this.active !== active) this.rows[active].row.scrollIntoView({ block: "nearest" });
    this.active = active;
    this.filter();
  }
  sorted({ order, demos }) {
    const by = { wrong: one => -one.expected_wrong, long: one => -one.steps, short: one => one.steps }[this.sort.value];
    if (this.sort.value === "name") return demos.map((_, index) => index);
    return by ? [...order].sort((a, b) => by(demos[a]) - by(demos[b])) : order;
  }
  draw() {
    if (!this.state) return;
    const width = this.root.clientWidth - 18, longest = Math.max(...this.state.demos.map(one => one.steps));
    this.state.demos.forEach(({ strip, steps }, index) => {
      const { canvas, row: box } = this.rows[index], key = JSON.stringify([strip, width, longest, this.state.colours, looks.paper]);
      if (box.hidden || canvas.key === key) return;
      canvas.key = key;
      const segments = strip.map(([start, option, source], n) => ({ start, stop: strip[n + 1]?.[0] ?? steps, option, source }));
      row(sharp(canvas, width, 8), segments, { place: step => step / longest * width, edge: width, top: 0, height: 8, colours: this.state.colours });
    });
  }
}

export class Options {  // names of the options: a key or a click names the segment, a text renames the option
  constructor(root, calls) {  // calls: name(option), rename(option, text), add(text), colour(option, colour), more(option, x, y)
    Object.assign(this, { root, calls, rows: [] });
    this.added = element("input", { placeholder: "new option", maxLength: 60 });
    this.added.setAttribute("aria-label", "Name of a new option");
    this.added.onchange = async () => {  // another one can be typed at once
      const text = this.added.value.trim();
      this.added.value = "";
      if (text && !await calls.add(text)) this.added.value ||= text;
    };
    root.append(element("div", {}, element("span", { className: "note", textContent: "+" }), this.added));
  }
  show({ names, colours }) {
    while (this.rows.length > names.length) this.rows.pop().row.remove();
    while (this.rows.length < names.length) this.rows.push(this.row(this.rows.length + 1));
    this.rows.forEach(({ button, colour, input }, n) => {
      colour.value = colours[n];
      button.setAttribute("aria-label", `Name the segment ${names[n]}`);
      if (input.known !== names[n]) input.value = input.known = names[n];
    });
  }
  row(number) {
    const button = element("button", { type: "button", textContent: number, title: `Name the segment under the cursor (${number})`, onclick: () => this.calls.name(number) });
    const colour = element("input", { type: "color", onchange: () => this.calls.colour(number, colour.value) });
    const input = element("input", { maxLength: 60, onchange: async () => { if (!await this.calls.rename(number, input.value)) input.value = input.known; } });
    const more = element("button", { type: "button", textContent: "⋯", title: "Merge or delete", onclick: ({ clientX, clientY }) => { const box = more.getBoundingClientRect(); this.calls.more(number, clientX || box.left, clientY || box.bottom); } });
    input.setAttribute("aria-label", `Name of option ${number}`);
    colour.setAttribute("aria-label", `Colour of option ${number}`); more.setAttribute("aria-label", `Merge or delete option ${number}`);
    const row = element("div", {}, button, colour, input, more);
    this.root.lastChild.before(row);
    return { row, button, colour, input };
  }
}

const FEW = 6;

export class Signals {  // which numbers are drawn over time
  constructor(root, changed) { Object.assign(this, { root, changed, names: null, off: new Set() }); }
  get chosen() { return this.names.map((_, row) => row).filter(row => !this.off.has(this.names[row])); }
  show(names) {
    if (String(names) === String(this.names)) return;
    if (!this.names) this.off = new Set(names.slice(FEW));
    this.names = names;
    this.root.replaceChildren(...names.map(name => {
      const box = element("input", { type: "checkbox", checked: !this.off.has(name), onchange: () => { this.off[box.checked ? "delete" : "add"](name); this.changed(); } });
      return element("label", {}, box, name);
    }));
  }
}

export const agrees = ({ kappa, boundary_f1: f1, same }) => `κ ${kappa === null ? "–" : kappa.toFixed(2)}, boundary F1 ${f1.toFixed(2)}, same names ${percent(same)}`;

export function readout(root, state, demo, cursor) {
  const segment = within(demo.segments, cursor), rate = state.frequency, boundary = demo.boundaries.find(one => one.step === segment.start), lines = [];
  const at = step => rate ? `${step} (${(step / rate).toFixed(2)} s)` : String(step);
  lines.push(["step", `${at(cursor)} of ${demo.steps}`]);
  lines.push([state.level, optionName(state, segment.option, segment.source), segment.source === "open" ? null : coloured(state.colours, segment.option)]);
  lines.push(["", { open: "left open", proposed: `proposed, probability ${(demo.heights[cursor] / 255).toFixed(2)}`, accepted: "accepted by you", given: "given by you" }[segment.source]]);
  lines.push(["steps", `${segment.start} to ${segment.stop - 1}`]);
  if (boundary && !boundary.said && boundary.high > boundary.low) lines.push(["begins at", `${boundary.low} to ${boundary.high}`]);
  for (const level of demo.upper) {
    const { option, source } = level.segments[last(level.segments.map(one => one.start), cursor)];
    lines.push([level.name, optionName(level, option, source), coloured(level.colours, option)]);
  }
  for (const other of demo.others) {
    const { option, source } = other.segments[last(other.segments.map(one => one.start), cursor)];
    lines.push([other.annotator, source === "open" ? "–" : other.names[option - 1], source === "open" ? null : coloured(other.colours, option)]);
    if (other.agreement) lines.push(["", agrees(other.agreement)]);
  }
  const numbers = (demo.numbers?.names ?? []).map((name, row) => [name, demo.numbers.decoded.value(row, cursor).toPrecision(3)]);
  const term = ([name, value, colour]) => element("div", {}, element("dt", { textContent: name }), element("dd", {}, ...(colour ? [swatch(colour)] : []), value));
  root.replaceChildren(element("dl", {}, ...lines.map(term)), element("dl", { className: "numbers" }, ...numbers.map(term)));
}

export function summary(root, { summary, demos, team }) {
  const { expected_wrong: wrong, one_more: saved, labelled } = summary;
  root.textContent = wrong === null ? `${labelled} of ${demos.length} accepted` : `Expected wrong steps now ${percent(wrong)}`
    + (saved === null ? "" : `; one more demonstration saves ${(100 * saved).toFixed(1)}`);
  for (const { name, done, of, agreement } of team) root.append(element("span", { className: "mark", textContent: `  ${name}: ${done} of ${of}${agreement ? `, ${agrees(agreement)}` : ""}` }));
}

export function alike(root, state, found, pictures, open) {
  root.hidden = !found.length;
  root.replaceChildren(element("h3", { textContent: "Alike elsewhere" }), element("div", { className: "bar" }, ...found.map(({ index, start, stop, option }) => {
    const { name } = state.demos[index], middle = (start + stop) >> 1;
    const button = element("button", { type: "button" }, ...(pictures ? [element("img", { src: `${pictures}/demo/${index}/picture/0/${middle}`, alt: "", height: 72 })] : []),
      element("span", {}, swatch(coloured(state.colours, option)), `${name}, steps ${start} to ${stop - 1}, ${optionName(state, option)}`));
    button.onclick = () => open(index, start);
    return button;
  })));
}
