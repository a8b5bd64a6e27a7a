// The page: what the server says is shown, what is chosen is asked for. All rules are the server's.

import { Board } from "./board.js";
import { Seat, complain, remember, remembered, say } from "./seat.js";
import { record, turnTable } from "./turns.js";

const $ = (id) => document.getElementById(id);
const seat = new Seat();
const board = new Board($("board"), choose);
const STILL = matchMedia("(prefers-reduced-motion: reduce)");
const STEP = 260; // milliseconds of one checker's way
const PAUSE = 700; // before a turn is confirmed by itself

let state = null;
let selected = null;
let moving = false; // checkers are on their way
let byKeyboard = false;
let hinted = ""; // the turn whose best moves are shown
let waiting; // until a turn is confirmed by itself

const name = (spot) => (spot === 25 || spot === "25" ? "bar" : spot === 0 || spot === "0" ? "off" : String(spot));
const number = (spot) => ({ bar: 25, off: 0 })[spot] ?? Number(spot);
const sources = () => Object.keys(state.moves).map(name);
const targets = () => (selected === null ? [] : state.moves[number(selected)].map(name));
const counted = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;

// ---- what is shown

async function show(found, animated) {
  state = found;
  selected = null;
  clearTimeout(waiting);
  const speed = STILL.matches || !animated ? 0 : STEP;
  $("result").hidden = true;
  setButtons(false);
  showDice();
  board.svg.classList.add("moving");
  moving = true;
  try {
    if (speed > 0 && state.steps.length) await board.play(state.before, state.steps, speed);
  } finally {
    moving = false;
    board.svg.classList.remove("moving");
  }
  if (state !== found) return;
  board.show(state.board);
  $("words").textContent = state.words;
  $("agent-pips").textContent = counted(state.board.agent.pips, "pip");
  $("your-pips").textContent = counted(state.board.you.pips, "pip");
  $("agent-score").textContent = counted(state.score.agent, "point");
  $("your-score").textContent = counted(state.score.you, "point");
  $("position-id").textContent = state.position_id;
  showAgentTurn();
  record($("record"), state.record);
  showResult();
  setButtons(true);
  if (sources().length === 1 && sources()[0] === "bar") selected = "bar";
  mark();
  say($("status"), told());
  showHints();
  document.body.dataset.revision = state.revision;
  if ($("automatic").checked && state.complete) waiting = setTimeout(() => act("confirm"), STILL.matches ? 0 : PAUSE);
}

function showDice() {
  const agents = state.agent_turn === null ? [] : state.agent_turn.dice;
  const four = agents.length && agents[0] === agents[1] ? [...agents, ...agents] : agents;
  board.showDice(state.dice, four.map((value) => ({ value, used: state.result === null || state.result.winner === "you" })));
}

function showAgentTurn() {
  const turn = state.agent_turn;
  $("agent-played").textContent = turn === null ? "It has not moved yet."
    : `${turn.dice.join("-")}: ${turn.text} — best of ${counted(turn.num_turns, "turn")}`;
  $("agent-best").replaceChildren(...(turn === null ? [] : [turnTable(turn.best, "What the agent thought of its roll")]));
}

function showResult() {
  const { result } = state;
  $("result").hidden = result === null;
  if (result === null) return;
  const what = { game: "the game", gammon: "a gammon", backgammon: "a backgammon" }[result.kind];
  const points = state.counts ? counted(result.points, "point") : `${counted(result.points, "point")}, not counted`;
  $("result").dataset.winner = result.winner;
  $("result-text").textContent = `${result.winner === "you" ? "You win" : "The agent wins"} ${what}: ${points}.`;
  if (byKeyboard) $("next").focus();
}

function setButtons(ready) {
  $("confirm").disabled = !ready || !state.complete;
  $("confirm").textContent = state.no_move ? "No legal move: pass" : "Confirm";
  $("undo").disabled = !ready || !state.can_undo;
}

function told() {
  if (state.result !== null) return $("result-text").textContent;
  const left = state.dice.filter((die) => !die.used).map((die) => die.value);
  const rolled = `You rolled ${state.dice.slice(0, 2).map((die) => die.value).join("-")}`;
  const turn = state.agent_turn;
  const before = turn === null || state.can_undo ? "" : turn.text === "no move"
    ? `The agent rolled ${turn.dice.join("-")} and could not move. `
    : `The agent rolled ${turn.dice.join("-")} and played ${turn.text}. `;
  if (state.no_move) return `${before}${rolled} and cannot move.`;
  if (state.complete) return left.length ? "Nothing more can be played: confirm, or undo." : "Turn played: confirm, or undo.";
  if (state.can_undo) return `${left.join(" and ")} left to play.`;
  return `${before}${rolled}${selected === "bar" ? ": enter from the bar." : ": choose a checker."}`;
}

function mark() {
  board.mark(moving ? [] : sources(), selected, targets(), describe);
}

function describe(spot, role) {
  const mine = spot === "off" ? state.board.you.off : spot === "bar" ? state.board.you.bar : state.board.you.points[spot - 1];
  const facing = spot === "off" || spot === "bar" ? 0 : state.board.agent.points[spot - 1];
  const where = { off: "Borne off", bar: "Your bar" }[spot] ?? `Point ${spot}`;
  const what = facing ? `${counted(facing, "checker")} of the agent` : mine ? `${counted(mine, "checker")} of yours` : "empty";
  const can = { source: ", can move", selected: ", chosen; choose where it goes", target: ", move here" }[role] ?? "";
  return `${where}, ${what}${can}`;
}

async function showHints() {
  const wanted = $("hints").checked && state.result === null;
  const turn = wanted ? `${state.num_games} ${state.record.length}` : "";
  if (turn === hinted && turn !== "") return;
  hinted = turn;
  if (!wanted) {
    $("hint-best").replaceChildren();
    return;
  }
  try {
    const found = await seat.ask("hint");
    if (hinted !== turn) return;
    $("hint-best").replaceChildren(turnTable(found.best, `The agent’s choice for you, of ${counted(found.num_turns, "turn")}`));
  } catch (error) {
    hinted = "";
    complain(error.message);
  }
}

// ---- what is done

async function act(what, fields) {
  if (moving) return; // what is on its way is shown first
  clearTimeout(waiting);
  const answer = await seat.act(what, fields);
  if (answer === null) return;
  complain(answer.complaint);
  if (answer.isNew) hinted = "";
  if (answer.state) await show(answer.state, what !== "undo" && !answer.complaint);
  settle(what);
}

// Whoever plays by keyboard finds the next choice where the focus is.
function settle(what) {
  if (!byKeyboard || state.result !== null) return;
  if (what === "move" && state.complete) $("confirm").focus();
  else if (["move", "undo", "confirm", "new"].includes(what)) {
    if (state.no_move) $("confirm").focus();
    else board.focus(selected === null ? sources()[0] : targets()[0]);
  }
}

function choose(spot) {
  if (moving || state === null || seat.busy) return;
  if (selected !== null && targets().includes(spot)) {
    act("move", { source: number(selected), target: number(spot) });
    return;
  }
  selected = spot !== selected && sources().includes(spot) ? spot : null;
  mark();
  if (byKeyboard && selected !== null) board.focus(targets()[0]);
}

function unselect() {
  const was = selected;
  selected = null;
  mark();
  if (was !== null) board.focus(was);
}

const KEYS = {
  u: () => $("undo").disabled || act("undo"),
  c: () => $("confirm").disabled || act("confirm"),
  h: () => $("hints").click(),
  b: () => board.focus(selected === null ? sources()[0] : targets()[0]),
  n: () => $("result").hidden || act("new"),
  Escape: unselect,
};

document.addEventListener("pointerdown", () => { byKeyboard = false; }, true);
document.addEventListener("keydown", (event) => {
  byKeyboard = true;
  if (event.ctrlKey || event.metaKey || event.altKey || state === null) return;
  const at = event.target;
  if (at.matches("input:not([type=checkbox])")) return;
  const spot = at.dataset?.spot;
  if (event.key.startsWith("Arrow") && (spot || at === document.body)) {
    event.preventDefault();
    board.focus(board.next(spot, event.key));
  } else if (spot && (event.key === "Enter" || event.key === " ")) {
    event.preventDefault();
    choose(spot);
  } else {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (Object.hasOwn(KEYS, key) && !event.repeat) KEYS[key]();
  }
});

$("confirm").addEventListener("click", () => act("confirm"));
$("undo").addEventListener("click", () => act("undo"));
$("next").addEventListener("click", () => act("new"));
$("new").addEventListener("click", () => act("new"));
for (const box of ["automatic", "hints"]) {
  $(box).checked = remembered(box, "") === "on";
  $(box).addEventListener("change", () => {
    remember(box, $(box).checked ? "on" : "");
    if (state === null) return;
    if (box === "hints") showHints();
    else if ($(box).checked && state.complete) act("confirm");
    else clearTimeout(waiting);
  });
}
$("copy").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText(state.position_id);
    $("copied").textContent = "copied";
  } catch {
    $("copied").textContent = "select it and copy it yourself";
  }
  setTimeout(() => { $("copied").textContent = ""; }, 2000);
});
$("set-up").addEventListener("submit", (event) => {
  event.preventDefault();
  const dice = $("set-dice").value.match(/\d+/g)?.join("") ?? "";
  const fields = { position: $("set-position").value.trim() };
  if ($("set-dice").value.trim()) fields.dice = [...dice].map(Number);
  hinted = "";
  act("new", fields);
});

try {
  const first = await seat.resume();
  await show(first.state, first.isNew);
} catch (error) {
  complain(error.message);
  say($("status"), "There is no game.");
}
