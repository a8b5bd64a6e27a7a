// The page: what the server says is shown, what is chosen is asked for. All rules are the server's.

import { Seat, complain, remember, remembered, say } from "./seat.js";

const $ = (id) => document.getElementById(id);
const seat = new Seat();
const STILL = matchMedia("(prefers-reduced-motion: reduce)");
const STEP = 260; // milliseconds of one step or jump
const CROWN = "M8 74L14 30L34 50L50 22L66 50L86 30L92 74Z";
const OTHER = { black: "white", white: "black" };

let state = null;
let selected = null;
let moving = false; // a piece is on its way
let byKeyboard = false;
let hinted = ""; // the turn whose moves are shown

const sources = () => Object.keys(state.moves).map(Number);
const targets = () => (selected === null ? [] : state.moves[selected] ?? []);
const counted = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
const rowOf = (square) => Math.floor((square - 1) / 4);
const columnOf = (square) => 2 * ((square - 1) % 4) + 1 - (rowOf(square) % 2);
const colourOf = (sign) => (sign.toLowerCase() === "b" ? "black" : "white");

function element(name, text, attributes = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// ---- the board: squares 1 to 32 from the top for who plays white, from the bottom for who plays black

const buttons = {};
for (let square = 1; square <= 32; square += 1) {
  const button = element("button", "", { type: "button", "data-square": square, tabindex: -1 });
  button.addEventListener("click", () => choose(square));
  buttons[square] = button;
}

function lay() {
  const cells = [];
  for (let row = 0; row < 8; row += 1) {
    for (let column = 0; column < 8; column += 1) {
      cells.push((row + column) % 2 ? buttons[4 * row + Math.floor(column / 2) + 1] : element("span", ""));
    }
  }
  $("squares").replaceChildren(...(state.player === "black" ? cells.reverse() : cells));
}

function pieceOf(sign) {
  const piece = element("span", "", { class: `piece ${colourOf(sign)}`, "aria-hidden": "true" });
  if (sign === sign.toUpperCase()) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 100 100");
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    path.setAttribute("d", CROWN);
    svg.append(path);
    piece.append(svg);
  }
  return piece;
}

function put(squares) {
  for (const [square, button] of Object.entries(buttons)) {
    const sign = squares[square - 1];
    const number = element("span", square, { class: "number", "aria-hidden": "true" });
    button.replaceChildren(number, ...(sign ? [pieceOf(sign)] : []));
  }
}

function mark() {
  const last = moving ? [] : state.steps.flatMap((step) => step.squares);
  const free = moving ? [] : sources();
  for (const [name, button] of Object.entries(buttons)) {
    const square = Number(name), sign = state.squares[square - 1];
    const role = square === selected ? "selected" : targets().includes(square) ? "target" : free.includes(square) ? "source" : "";
    button.className = [role, last.includes(square) ? "last" : ""].filter(Boolean).join(" ");
    button.tabIndex = role ? 0 : -1;
    button.setAttribute("aria-disabled", String(!role));
    if (role === "selected") button.setAttribute("aria-pressed", "true");
    else button.removeAttribute("aria-pressed");
    const what = sign ? `${colourOf(sign) === state.player ? "your" : "the agent’s"} ${sign === sign.toUpperCase() ? "king" : "man"}` : "empty";
    const can = { source: ", can move", selected: ", chosen; choose where it goes", target: ", move here" }[role] ?? "";
    button.setAttribute("aria-label", `Square ${square}, ${what}${can}`);
  }
}

async function travel(step) {
  const turned = state.player === "black" ? -1 : 1;
  for (let i = 1; i < step.squares.length; i += 1) {
    const [from, to] = [step.squares[i - 1], step.squares[i]];
    const piece = buttons[from].querySelector(".piece");
    if (!piece) return;
    const size = buttons[from].getBoundingClientRect().width;
    const [x, y] = [columnOf(to) - columnOf(from), rowOf(to) - rowOf(from)].map((by) => by * turned * size);
    buttons[from].style.zIndex = 2;
    await piece.animate([{ transform: "none" }, { transform: `translate(${x}px, ${y}px)` }], {
      duration: STEP, easing: "ease-in-out",
    }).finished;
    buttons[from].style.zIndex = "";
    buttons[to].append(piece);
    if (step.taken[i - 1]) buttons[step.taken[i - 1]].querySelector(".piece")?.remove();
  }
}

// ---- what is shown

async function show(found, animated) {
  const turned = state === null || state.player !== found.player;
  state = found;
  selected = null;
  if (turned) lay();
  $("result").hidden = true;
  $("undo").disabled = true;
  moving = true;
  $("squares").classList.add("moving");
  try {
    if (animated && !STILL.matches && state.steps.length) {
      put(state.before);
      mark();
      for (const step of state.steps) await travel(step);
    }
  } finally {
    moving = false;
    $("squares").classList.remove("moving");
  }
  if (state !== found) return;
  put(state.squares);
  if (state.goes_on) [selected] = sources();
  showCounts();
  showAgentMove();
  showRecord();
  showResult();
  $("undo").disabled = !state.can_undo;
  mark();
  say($("status"), told());
  showHints();
  document.body.dataset.revision = state.revision;
}

function showCounts() {
  const mine = state.squares.filter((sign) => sign && colourOf(sign) === state.player).length;
  const theirs = state.squares.filter(Boolean).length - mine;
  $("words").textContent = state.words;
  $("your-pieces").textContent = `${state.player}, ${counted(mine, "piece")}`;
  $("agent-pieces").textContent = `${OTHER[state.player]}, ${counted(theirs, "piece")}`;
  $("your-dot").className = `dot ${state.player}`;
  $("agent-dot").className = `dot ${OTHER[state.player]}`;
  $("your-score").textContent = `won ${state.score.you}, drawn ${state.score.draws}`;
  $("agent-score").textContent = `won ${state.score.agent}`;
  $("fen").textContent = state.fen;
}

function scored({ score, plies }) {
  if (plies === null) return `${score < 0 ? "−" : "+"}${Math.abs(score).toFixed(2)}`;
  return `${score > 0 ? "wins" : "loses"} in ${plies}`;
}

function moveTable(moves, caption) {
  const table = element("table", "", { class: "turns" });
  const head = element("thead", ""), body = element("tbody", ""), top = element("tr", "");
  top.append(element("th", "Move", { scope: "col" }), element("th", "Score", { scope: "col", title: "men" }));
  head.append(top);
  moves.forEach((one, i) => {
    const row = element("tr", "", i === 0 ? { class: "best" } : {});
    row.append(element("th", one.text, { scope: "row" }), element("td", scored(one)));
    body.append(row);
  });
  table.append(element("caption", caption), head, body);
  return table;
}

function showAgentMove() {
  const move = state.agent_move;
  $("agent-played").textContent = move === null ? "It has not moved yet." : `${move.text}, of ${counted(move.num_moves, "move")}`;
  $("agent-best").replaceChildren(...(move === null ? [] : [moveTable(move.best, "What it thought of its moves")]));
}

function showRecord() {
  const rows = state.record.map((entry) => {
    const row = element("li", "", { class: entry.who });
    row.append(element("span", `${entry.who === "you" ? "You" : "Agent"} `, { class: "who" }), element("span", entry.text));
    if (entry.who === "you") {
      const ordinal = { 2: "2nd", 3: "3rd" }[entry.rank] ?? `no. ${entry.rank}`;
      const much = entry.loss > 50 ? "decisive" : `−${entry.loss.toFixed(2)}`;
      const verdict = entry.rank === 1 ? "best" : `${ordinal}, ${much}`;
      row.append(element("span", ` ${verdict}`, { class: `verdict ${entry.rank === 1 ? "good" : entry.loss > 0.8 ? "bad" : ""}` }));
    }
    return row;
  });
  $("record").replaceChildren(...rows);
  $("record").scrollTop = $("record").scrollHeight;
}

function showResult() {
  const { result } = state;
  $("result").hidden = result === null;
  if (result === null) return;
  $("result").dataset.winner = result.winner ?? "nobody";
  const how = result.blocked ? "no move is left" : "no piece is left";
  const what = { you: `You win: ${how}.`, agent: `The agent wins: ${how}.` }[result.winner] ?? "A draw: sixty quiet moves.";
  $("result-text").textContent = state.counts ? what : `${what} Not counted.`;
  if (byKeyboard) $("next").focus();
}

function told() {
  if (state.result !== null) return $("result-text").textContent;
  if (state.goes_on) return "Go on: the same piece captures again.";
  const before = state.agent_move === null || !state.record.length ? "" : `The agent played ${state.agent_move.text}. `;
  if (state.must_capture) return `${before}You must capture.`;
  return `${before}Choose a piece.`;
}

async function showHints() {
  const wanted = $("hints").checked && state.result === null;
  const turn = wanted ? state.fen : "";
  if (turn === hinted && turn !== "") return;
  hinted = turn;
  if (!wanted) {
    $("hint-best").replaceChildren();
    return;
  }
  try {
    const found = await seat.ask("hint");
    if (hinted === turn) $("hint-best").replaceChildren(moveTable(found.best, `The best of ${counted(found.num_moves, "move")}`));
  } catch (error) {
    hinted = "";
    complain(error.message);
  }
}

// ---- what is done

async function act(what, fields) {
  if (moving || state === null) return; // what is on its way is shown first
  const answer = await seat.act(what, fields);
  if (answer === null) return;
  complain(answer.complaint);
  if (answer.state) await show(answer.state, what !== "undo" && !answer.complaint && answer.state.steps.some((step) => step.who === "agent"));
  if (byKeyboard && state.result === null) focus(selected === null ? sources()[0] : targets()[0]);
}

function focus(square) {
  buttons[square]?.focus();
}

function choose(square) {
  if (moving || state === null || seat.busy) return;
  if (selected !== null && targets().includes(square)) {
    act("move", { source: selected, target: square });
    return;
  }
  if (state.goes_on) return;
  selected = square !== selected && sources().includes(square) ? square : null;
  mark();
  if (byKeyboard && selected !== null) focus(targets()[0]);
}

// The nearest square that can be chosen in the direction of an arrow key; from nowhere, the first.
function next(square, key) {
  const free = Object.keys(buttons).map(Number).filter((one) => buttons[one].tabIndex === 0);
  if (!square) return free[0];
  const turned = state.player === "black" ? -1 : 1;
  const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key].map((by) => by * turned);
  let best, least = Infinity;
  for (const one of free) {
    const [x, y] = [columnOf(one) - columnOf(square), rowOf(one) - rowOf(square)];
    const along = x * dx + y * dy, across = Math.abs(x * dy) + Math.abs(y * dx);
    if (one !== square && along > 0 && along + 3 * across < least) [best, least] = [one, along + 3 * across];
  }
  return best ?? free[(free.indexOf(square) + 1) % free.length];
}

const KEYS = {
  u: () => $("undo").disabled || act("undo"),
  h: () => $("hints").click(),
  n: () => $("result").hidden || act("new", { player: OTHER[state.player] }),
  Escape: () => {
    if (state.goes_on || selected === null) return;
    const was = selected;
    selected = null;
    mark();
    focus(was);
  },
};

document.addEventListener("pointerdown", () => { byKeyboard = false; }, true);
document.addEventListener("keydown", (event) => {
  byKeyboard = true;
  if (event.ctrlKey || event.metaKey || event.altKey || state === null) return;
  const at = event.target;
  if (at.matches("input:not([type=checkbox])")) return;
  const square = Number(at.dataset?.square ?? 0);
  if (event.key.startsWith("Arrow") && (square || at === document.body)) {
    event.preventDefault();
    focus(next(square, event.key));
  } else {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (Object.hasOwn(KEYS, key) && !event.repeat) KEYS[key]();
  }
});

$("undo").addEventListener("click", () => act("undo"));
$("next").addEventListener("click", () => act("new", { player: OTHER[state.player] }));
$("as-black").addEventListener("click", () => act("new", { player: "black" }));
$("as-white").addEventListener("click", () => act("new", { player: "white" }));
$("hints").checked = remembered("checkers-hints", "") === "on";
$("hints").addEventListener("change", () => {
  remember("checkers-hints", $("hints").checked ? "on" : "");
  if (state !== null) showHints();
});
$("copy").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText(state.fen);
    $("copied").textContent = "copied";
  } catch {
    $("copied").textContent = "select it and copy it yourself";
  }
  setTimeout(() => { $("copied").textContent = ""; }, 2000);
});
$("set-up").addEventListener("submit", (event) => {
  event.preventDefault();
  act("new", { position: $("set-position").value.trim() });
});

try {
  const first = await seat.resume();
  await show(first.state, first.isNew);
} catch (error) {
  complain(error.message);
  say($("status"), "There is no game.");
}
