// What stands beside the time line: the list of demonstrations, options, the readout, and what is alike.
import { last, sharp } from "./canvas.js";
import { coloured, element, looks, percent, row, within } from "./drawing.js";

const swatch = colour => { const made = element("span", { className: "swatch" }); made.style.background = colour; return made; };

export const optionName = (state, option, source) => source === "open" ? "open" : option ? state.names[option - 1] ?? `option ${option}` : "control";

export class List {  // all demonstrations, the most informative first, each with its segments
  constructor(root, find, count, open) {
    Object.assign(this, { root, find, count, open, rows: [], order: [] });
    find.oninput = () => this.filter();
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
    const words = this.find.value.trim().toLowerCase();
    this.rows.forEach(({ row, name }) => { row.hidden = !name.textContent.toLowerCase().includes(words); });
    this.draw();
  }
  show(state, active, keep) {  // keep: the order stays until another demonstration is opened
    if (!this.rows.length) this.rows = state.demos.map((demo, index) => {
      const [name, mark, reason, canvas] = [element("strong", { textContent: demo.name }), element("span", { className: "mark" }), element("small"), element("canvas")];
      const row = element("div", { id: `demo-${index}` }, name, mark, reason, canvas);
      row.setAttribute("role", "option"); row.dataset.index = index;
      return { row, name, mark, reason, canvas };
    });
    if (!keep || !this.order.length) { this.order = state.order; this.root.replaceChildren(...state.order.map(index => this.rows[index].row)); }
    state.demos.forEach((demo, index) => {
      const { row, mark, reason } = this.rows[index], changed = demo.changed && index !== active;
      row.setAttribute("aria-selected", index === active);
      mark.textContent = [demo.accepted && "✓ accepted", changed && "● changed", demo.held_out && "held out"].filter(Boolean).join("  ");
      reason.textContent = demo.accepted ? `${demo.steps} steps` : demo.reason;
    });
    this.state = state;
    this.count.textContent = `${state.demos.filter(one => one.accepted).length} of ${state.demos.length} accepted`;
    this.root.setAttribute("aria-activedescendant", `demo-${active}`);
    if (this.active !== active) this.rows[active].row.scrollIntoView({ block: "nearest" });
    this.active = active;
    this.draw();
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
  constructor(root, calls) {  // calls: name(option), rename(option, text), add(text)
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
      colour.style.background = colours[n];
      button.setAttribute("aria-label", `Name the segment ${names[n]}`);
      if (input.known !== names[n]) input.value = input.known = names[n];
    });
  }
  row(number) {
    const colour = swatch(""), button = element("button", { type: "button", title: `Name the segment under the cursor (${number})`, onclick: () => this.calls.name(number) }, colour, String(number));
    const input = element("input", { maxLength: 60, onchange: async () => { if (!await this.calls.rename(number, input.value)) input.value = input.known; } });
    input.setAttribute("aria-label", `Name of option ${number}`);
    const row = element("div", {}, button, input);
    this.root.lastChild.before(row);
    return { row, button, colour, input };
  }
}

export function readout(root, state, demo, cursor) {
  const segment = within(demo.segments, cursor), rate = state.frequency, boundary = demo.boundaries.find(one => one.step === segment.start), lines = [];
  const at = step => rate ? `${step} (${(step / rate).toFixed(2)} s)` : String(step);
  lines.push(["step", `${at(cursor)} of ${demo.steps}`]);
  lines.push([state.level, optionName(state, segment.option, segment.source), segment.source === "open" ? null : coloured(state.colours, segment.option)]);
  lines.push(["", { open: "left open", proposed: `proposed, probability ${(demo.heights[cursor] / 255).toFixed(2)}`, accepted: "accepted by you", given: "given by you" }[segment.source]]);
  lines.push(["steps", `${segment.start} to ${segment.stop - 1}`]);
  if (boundary && !boundary.said && boundary.high > boundary.low) lines.push(["begins at", `${boundary.low} to ${boundary.high}`]);
  for (const level of demo.upper) {
    const option = level.segments[last(level.segments.map(one => one.start), cursor)].option;
    lines.push([level.level, option ? level.names[option - 1] : "control", coloured(level.colours, option)]);
  }
  const numbers = (demo.numbers?.names ?? []).map((name, row) => [name, demo.numbers.decoded.value(row, cursor).toPrecision(3)]);
  const term = ([name, value, colour]) => element("div", {}, element("dt", { textContent: name }), element("dd", {}, ...(colour ? [swatch(colour)] : []), value));
  root.replaceChildren(element("dl", {}, ...lines.map(term)), element("dl", { className: "numbers" }, ...numbers.map(term)));
}

export function summary(root, { summary, demos }) {
  const { expected_wrong: wrong, one_more: saved, labelled } = summary;
  root.textContent = wrong === null ? `${labelled} of ${demos.length} accepted` : `Expected wrong steps now ${percent(wrong)}`
    + (saved === null ? "" : `; one more demonstration saves ${(100 * saved).toFixed(1)}`);
}

export function alike(root, state, found, pictures, open) {
  root.hidden = !found.length;
  root.replaceChildren(element("h3", { textContent: "Alike elsewhere" }), element("div", { className: "bar" }, ...found.map(({ index, start, stop, option }) => {
    const { name } = state.demos[index], middle = (start + stop) >> 1;
    const button = element("button", { type: "button" }, ...(pictures ? [element("img", { src: `demo/${index}/picture/${middle}`, alt: "", height: 72 })] : []),
      element("span", {}, swatch(coloured(state.colours, option)), `${name}, steps ${start} to ${stop - 1}, ${optionName(state, option)}`));
    button.onclick = () => open(index, start);
    return button;
  })));
}
