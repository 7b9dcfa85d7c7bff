// The page: what the server says, what a person does, and the keys.
import { Look, element, onScheme, percent, within } from "./drawing.js";
import { List, Options, Signals, agrees, alike, optionName, readout, summary } from "./panels.js";
import { Timeline } from "./timeline.js";

const $ = id => document.getElementById(id), EVERY = 1000, SOON = 150, ALIKE = 250;
const SPEEDS = [.25, .5, 1, 2, 4];
let level = 0, state = null, demo = null, wanted = null, cursor = 0, playing = null, painting = null, moving = null, waiting = Promise.resolve(), asked = 0, silent = false, looping = false, fromHere = false;

async function ask(path, body) {
  let answer, found;
  try {
    answer = await fetch(`level/${level}/${path}`, body === undefined ? {} : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    found = await answer.json();
  } catch { throw new Error(body === undefined ? "the server does not answer" : "the server does not answer; what you did last may be lost"); }
  if (!answer.ok) throw new Error(found.error);
  return found;
}
const say = (text, bad = false) => { $("said").textContent = text; $("said").classList.toggle("bad", bad); };
const tried = async work => { try { return await work(); } catch (error) { say(error.message, true); return null; } };
const option = number => optionName(state, number);
const change = ({ expected_wrong: before }, { expected_wrong: after }) => before === null || after === null ? "" : `: expected wrong steps ${percent(before)} before, ${percent(after)} now`;

const seek = step => {
  cursor = Math.min(Math.max(step, 0), demo.steps - 1);
  timeline.seek(cursor); look.at(cursor); readout($("readout"), state, demo, cursor);
  const segment = within(demo.segments, cursor), name = optionName(state, segment.option, segment.source);
  $("timeline").setAttribute("aria-valuenow", cursor);
  $("timeline").setAttribute("aria-valuetext", `step ${cursor} of ${demo.steps}, ${name}, ${segment.source}, steps ${segment.start} to ${segment.stop - 1}`);
  clearTimeout(asked);
  if (!playing) asked = setTimeout(neighbours, ALIKE);
};
async function neighbours() {
  const { index } = demo, segment = within(demo.segments, cursor), found = await tried(() => ask(`demo/${index}/nearest/${cursor}`));
  if (found && demo.index === index && within(demo.segments, cursor).start === segment.start) alike($("nearest"), state, found, demo.cameras.length && `level/${level}`, (other, step) => open(other, step));
  history.replaceState(null, "", `#${index}/${cursor}${level ? `/${level}` : ""}`);
}

const timeline = new Timeline($("timeline"), { seek, split: step => edit({ do: "split", demo: demo.index, step }), drop, menu: (x, y) => menu(x, y), level: number => enter(number), other: (other, x, y) => compare(other, x, y) });
const look = new Look($("look"), 280, 190);
const list = new List($("list"), $("find"), $("sort"), $("filter"), $("count"), index => open(index));
const options = new Options($("options"), {
  name: number => act(number), rename: (number, text) => edit({ do: "rename", option: number, text }), add: text => edit({ do: "new", text }),
  colour: (number, colour) => edit({ do: "colour", option: number, colour }),
  more: (number, x, y) => popup(x, y, option(number), [
    ...state.names.map((name, n) => [`Merge into ${name}`, () => edit({ do: "drop", option: number, into: n + 1 }, `${option(number)} merged into ${name}, seen`)]).filter((_, n) => n + 1 !== number),
    ["Delete", () => edit({ do: "drop", option: number }, `${option(number)} deleted, seen`)],
  ]),
});
const signals = new Signals($("signals"), () => { timeline.show(demo, state, signals.chosen); });
function render(keep = true) {
  document.title = `Labelling ${state.title}`;
  $("title").textContent = state.title;
  summary($("summary"), state);
  status(state);
  $("work").hidden = false;
  document.querySelector("[data-do=undo]").disabled = !state.can_undo;
  document.querySelector("[data-do=redo]").disabled = !state.can_redo;
  list.show(state, demo.index, keep);
  options.show(state);
  const { name, accepted, held_out: held, reason, marks, people, done_by: done } = state.demos[demo.index];
  $("name").textContent = name;
  $("task").textContent = demo.task;
  for (const mark of ["exclude", "flag"]) document.querySelector(`[data-do=${mark}]`).setAttribute("aria-pressed", marks[mark] === true);
  if (document.activeElement !== $("note")) $("note").value = marks.note ?? "";
  document.querySelector(".bar [data-do=from_here]").setAttribute("aria-pressed", fromHere);
  document.querySelector("[data-do=loop]").setAttribute("aria-pressed", looping);
  $("scratch").hidden = fromHere || !state.scratch;
  document.querySelector("[data-do=accept]").hidden = accepted; document.querySelector("[data-do=reopen]").hidden = !accepted;
  $("reason").textContent = [marks.exclude && "excluded", accepted && "accepted", held && "held out", people.length && `of ${people.join(" and ")}`, done.length && `accepted by ${done.join(", ")}`, reason].filter(Boolean).join(" · ");
  signals.show(demo.numbers?.names ?? []); timeline.show(demo, state, signals.chosen); look.show(demo, demo.segments, state.colours, `level/${level}`);
  $("timeline").setAttribute("aria-valuemin", 0); $("timeline").setAttribute("aria-valuemax", demo.steps - 1);
  seek(cursor);
}
function status({ refit, warnings, dirty, features }) {
  $("features").textContent = features;
  $("fitting").hidden = !refit.running;
  const bar = $("fitting").querySelector("progress");
  if (refit.progress === null) bar.removeAttribute("value"); else bar.value = refit.progress;
  document.querySelector("[data-do=refit]").disabled = refit.running;
  const lines = [...warnings, ...(refit.error ? [refit.error] : []), ...(silent ? ["the server does not answer; start it again and open the address it prints"] : [])];
  if ($("warnings").textContent !== lines.join("")) $("warnings").replaceChildren(...lines.map(text => element("p", { textContent: text })));
  document.querySelector("[data-do=save]").textContent = dirty ? "Save •" : "Save";
}
// Every answer says which demonstration it shows, and of which revision. What is no longer wanted, or older than what is shown, is dropped.
async function show(index, step, keep = true) {
  wanted = { index, step: step ?? (index === wanted?.index ? wanted.step : undefined), keep };
  const found = await ask(`view/${index}`), known = state?.level === found.state.level ? state : null;
  if (found.demo.index !== wanted.index || found.state.levels[level] !== found.state.level || found.state.revision < (known?.revision ?? 0)) return;
  if (known && known.refit.done < found.state.refit.done) say(`Refit ${found.state.refit.done} is done${change(known.summary, found.state.summary)}`);
  [state, demo, silent, cursor] = [found.state, found.demo, false, wanted.step ?? cursor];
  wanted.step = undefined;
  render(wanted.keep && list.active === index);
}
async function begin() {
  const [, index, step, on] = location.hash.match(/^#(\d+)\/(\d+)(?:\/(\d+))?$/) ?? [];
  level = Number(on ?? 0);
  const found = await ask("state");
  if (index < found.demos.length) await show(Number(index), Number(step)); else await show(found.order[0], 0);
}
const open = (index, step = 0, keep = true) => tried(async () => { stop(); await show(index, step, keep); });

const enter = number => waiting = waiting.then(() => tried(async () => {  // another level of the same demonstration
  if (number === level) return;
  stop();
  level = number;
  await show(demo.index, cursor);
  say(`Level ${state.level}`);
}));
const compare = ({ annotator, agreement }, x, y) => popup(x, y, annotator, [[`Take the labels of ${annotator}${agreement ? `: ${agrees(agreement)}` : ""}`, () => edit({ do: "take", demo: demo.index, annotator }, `Labels of ${annotator} taken`)]]);

// One edit after the other: each is in the journal when the server answers.
const DONE = { undo: "Undone", redo: "Done again", split: "Split", merge: "Merged", open: "Left open", move: "Moved", rename: "Renamed", new: "New option", accept: "Accepted", reopen: "Taken back", mark: "Marked", colour: "Coloured", drop: "Dropped", take: "Taken" };
const edit = (command, words) => waiting = waiting.then(() => tried(async () => {
  const made = typeof command === "function" ? command() : command, at = wanted.index;
  if (!made) return false;
  const found = await ask("edit", made), back = ["undo", "redo"].includes(made.do) && wanted.index === at && found.demo !== null && found.demo !== at;
  await show(back ? found.demo : wanted.index, back ? 0 : undefined);
  say(found.done ? `${words ?? DONE[made.do]} in ${state.demos[found.demo ?? at].name}` : "That changes nothing");
  return found.done;
}));
const act = number => edit({ do: "name", demo: demo.index, step: cursor, option: number, from_here: fromHere }, option(number));
const mark = (name, value) => edit({ do: "mark", demo: demo.index, mark: name, value });
const toggle = name => mark(name, !state.demos[demo.index].marks[name]);
const everywhere = number => edit({ do: "everywhere", demo: demo.index, step: cursor, option: number }, `${option(number)} everywhere, as`);
function drop({ boundary, to }) {
  return boundary === to ? timeline.hold(null) : edit({ do: "move", demo: demo.index, boundary, to }).then(done => { timeline.hold(null); if (done) seek(Math.min(to, demo.steps - 1)); });
}
function accept() {  // what is seen; what is accepted stays so
  const { index } = demo, next = () => {
    const other = state.order.find(one => !state.demos[one].accepted && !state.demos[one].marks.exclude);
    if (other === undefined) say("All demonstrations are accepted"); else open(other, 0, false);
  };
  if (state.demos[index].accepted) { next(); return; }
  const seen = () => demo.index === index && !state.demos[index].accepted && { do: "accept", demo: index, segments: demo.segments.map(one => [one.start, one.option]) };
  edit(seen).then(done => { if (done && wanted.index === index) next(); });
}
function uncertain() {  // the most uncertain boundary; pressed again there, the next one
  const places = state.uncertain, at = places.findIndex(one => one.demo === demo.index && one.step === cursor), next = places[(at + 1) % places.length];
  if (next) open(next.demo, next.step).then(() => say(`Boundary ${(at + 1) % places.length + 1} of the ${places.length} most uncertain: ${demo.name}, step ${next.step}`));
  else say("No boundary is uncertain");
}
const boundaries = () => demo.segments.slice(1).map(one => one.start);
function shove(steps) {  // the nearest boundary moves when the key is released
  if (!moving) {
    const nearest = boundaries().sort((a, b) => Math.abs(a - cursor) - Math.abs(b - cursor))[0];
    if (nearest === undefined) { say("There is no boundary", true); return; }
    moving = { boundary: nearest, to: nearest };
  }
  moving = timeline.moved(moving.boundary, moving.to + steps);
  say(`Boundary ${moving.boundary} to step ${moving.to}`);
}
function release() {  // of what is held: a boundary that moves, or a number that paints
  const [held, painted] = [moving, painting];
  moving = painting = null;
  if (held) drop(held);
  if (!painted) return;
  const stretch = timeline.preview ?? { start: painted.start, stop: painted.start + 1 };
  edit({ do: "paint", demo: demo.index, start: stretch.start, stop: stretch.stop, option: painted.option }, `${painted.option ? option(painted.option) : "Open"} from step ${stretch.start} to ${stretch.stop - 1}`).then(() => timeline.hold(null));
}

function play() {
  if (playing) { stop(); return; }
  if (cursor >= demo.steps - 1) seek(0);
  const { start, stop: end } = within(demo.segments, cursor), begin = { step: cursor, time: performance.now() };
  playing = begin;
  document.querySelector("[data-do=play]").textContent = "Stop";
  const turn = now => {
    if (playing !== begin) return;
    const rate = (state.frequency ?? 20) * Number($("speed").value), at = begin.step + Math.floor(Math.max(now - begin.time, 0) / 1000 * rate);
    if (looping && !painting && at >= end) { [begin.step, begin.time] = [start, now]; seek(start); requestAnimationFrame(turn); return; }
    if (at !== cursor) seek(at);
    if (painting) timeline.hold({ start: painting.start, stop: cursor + 1, option: painting.option });
    if (at >= demo.steps - 1) { stop(); return; }
    requestAnimationFrame(turn);
  };
  requestAnimationFrame(turn);
}
function stop() {
  if (!playing) return;
  playing = null;
  document.querySelector("[data-do=play]").textContent = "Play";
  release(); seek(cursor);
}

function popup(x, y, name, items) {  // a menu of [text, work]
  const box = $("menu"), close = () => { box.hidden = true; $("timeline").focus(); };
  box.setAttribute("aria-label", name);
  box.replaceChildren(...items.map(([text, work]) => {
    const made = element("button", { type: "button", textContent: text, tabIndex: -1, onclick: () => { close(); work(); } });
    made.setAttribute("role", "menuitem");
    return made;
  }));
  box.hidden = false;
  Object.assign(box.style, { left: `${Math.min(x, innerWidth - box.offsetWidth - 8)}px`, top: `${Math.max(8, Math.min(y, innerHeight - box.offsetHeight - 8))}px` });
  const made = [...box.children], go = step => made[(made.indexOf(document.activeElement) + step + made.length) % made.length].focus();
  made[0].focus();
  box.onkeydown = event => {
    event.stopPropagation();
    if (event.key === "ArrowDown") go(1); else if (event.key === "ArrowUp") go(-1);
    else if (event.key === "Escape" || event.key === "Tab") close(); else return;
    event.preventDefault();
  };
}
const speed = by => { const at = Math.min(Math.max(SPEEDS.indexOf(Number($("speed").value)) + by, 0), SPEEDS.length - 1); $("speed").value = SPEEDS[at]; if (playing) { play(); play(); } say(`Speed ${SPEEDS[at]} ×`); };
const menu = (x, y) => popup(x, y, "Segment", [
  ...state.names.map((name, n) => [`${n + 1}  ${name}`, () => act(n + 1)]), ["New option …", () => options.added.focus()],
  ["Split here  S", commands.split], ["Merge with the next  M", commands.merge], ["Leave open  0", commands.open], ["Accept all  Enter", commands.accept],
]);
addEventListener("pointerdown", event => { if (!$("menu").contains(event.target)) $("menu").hidden = true; });
const download = format => tried(async () => {  // leaves the page where it is
  const answer = await fetch(`level/${level}/export/${encodeURIComponent(format)}`);
  if (!answer.ok) throw new Error((await answer.json()).error);
  const name = answer.headers.get("content-disposition").match(/filename="?([^";]+)/)[1], url = URL.createObjectURL(await answer.blob());
  element("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), EVERY);
  say(`${name} is downloaded`);
});

const here = name => () => edit({ do: name, demo: demo.index, step: cursor });
const commands = {
  undo: () => edit({ do: "undo" }), redo: () => edit({ do: "redo" }), split: here("split"), merge: here("merge"), open: () => edit({ do: "open", demo: demo.index, step: cursor, from_here: fromHere }), accept, reopen: () => edit({ do: "reopen", demo: demo.index }), play, uncertain,
  refit: () => tried(async () => { await ask("refit", {}); await poll(); say("Refit begun"); }),
  cancel: () => tried(async () => { if (!state.refit.running) { say("Nothing is under way"); return; } await ask("cancel", {}); await poll(); say("Cancelled; what is shown stays"); }),
  save: () => tried(async () => { say((await ask("save", {})).message); status(Object.assign(state, { dirty: false })); }),
  export: () => { const { left, bottom } = document.querySelector("[data-do=export]").getBoundingClientRect(); popup(left, bottom, "Export", state.formats.map(name => [name, () => download(name)])); },
  exclude: () => toggle("exclude"), flag: () => toggle("flag"), note: () => $("note").focus(),
  from_here: () => { fromHere = !fromHere; render(); say(fromHere ? "A name goes from the cursor over all that is proposed" : "A name is of the whole segment"); },
  loop: () => { looping = !looping; render(); say(looping ? "Playing repeats the segment" : "Playing goes on to the end"); }, slower: () => speed(-1), faster: () => speed(1),
  help: () => $("help").showModal(), find: () => $("find").focus(),
  closer: () => timeline.zoom(.5), wider: () => timeline.zoom(2), all: () => timeline.all(),
  next: () => seek(boundaries().find(step => step > cursor) ?? cursor), previous: () => seek(boundaries().reverse().find(step => step < cursor) ?? 0),
};
const KEYS = {
  " ": "play", j: "next", k: "previous", s: "split", m: "merge", Enter: "accept", g: "uncertain", u: "undo", "/": "find", "?": "help", "+": "closer", "=": "closer", "-": "wider", a: "all", r: "refit", c: "cancel", x: "exclude", f: "flag", n: "note", t: "from_here", l: "loop", ",": "slower", ".": "faster",
};
$("note").onchange = () => mark("note", $("note").value.trim());
for (const button of document.querySelectorAll("[data-do]")) button.addEventListener("click", event => {
  commands[button.dataset.do]();
  if (event.detail && demo && !["help", "export"].includes(button.dataset.do)) $("timeline").focus();  // a click leaves the keys to the time line
});
addEventListener("keydown", event => {
  const { target, key, code, shiftKey } = event, digit = code.match(/^(?:Digit|Numpad)(\d)$/)?.[1], typed = target.matches("input:not([type=range], [type=checkbox], [type=color]), textarea, select");
  if (event.defaultPrevented || $("help").open || !state) return;
  if (typed) { if (key === "Escape" && target !== $("find")) $("timeline").focus(); return; }
  const alone = !event.ctrlKey && !event.metaKey && !event.altKey, graphic = alone || event.getModifierState("AltGraph");
  if (!demo || (target.matches("button, a, summary") && (key === " " || key === "Enter"))) return;
  const bracket = graphic ? (key === "[" || code === "BracketLeft" && alone ? -1 : key === "]" || code === "BracketRight" && alone ? 1 : 0) : 0;
  if (bracket) shove(bracket * (shiftKey && alone ? 10 : 1));
  else if (key.toLowerCase() === "z" && (event.ctrlKey || event.metaKey)) commands[shiftKey ? "redo" : "undo"]();
  else if (!alone) return;
  else if (digit !== undefined && key !== "/" && key !== "=") {
    if (event.repeat) { event.preventDefault(); return; }
    if (Number(digit) > state.names.length) say(`There are ${state.names.length} options; name a new one first`, true);
    else if (playing) painting = { code, option: Number(digit), start: cursor };
    else if (digit === "0") commands.open();
    else (shiftKey ? everywhere : act)(Number(digit));
  } else if (key === "ArrowLeft" || key === "ArrowRight") { stop(); seek(cursor + (key === "ArrowLeft" ? -1 : 1) * (shiftKey ? 10 : 1)); }
  else if (key === "Home") seek(0);
  else if (key === "End") seek(demo.steps - 1);
  else if (key.toLowerCase() === "u" && shiftKey) commands.redo();
  else if (KEYS[key] ?? KEYS[key.toLowerCase()]) { if (!event.repeat || "jk".includes(key)) commands[KEYS[key] ?? KEYS[key.toLowerCase()]](); }
  else return;
  event.preventDefault();
});
addEventListener("keyup", event => { if (moving && /Bracket|^\[|^\]|Digit[89]/.test(event.code) || painting?.code === event.code) release(); });
addEventListener("blur", () => { if (moving || painting) release(); });
onScheme(() => { if (state) render(); });

async function poll() {
  try {
    const { revision, ...found } = await ask("poll");
    silent = false;
    if (!state) await begin();
    else if (revision > state.revision && !playing && !timeline.drag && !moving) await show(wanted.index);
    else if (revision >= state.revision) status(Object.assign(state, found));
  } catch { silent = true; if (state) status(state); }
  setTimeout(poll, state?.behind ? SOON : EVERY);
}
await tried(begin);
poll();
