// The page: what the server says is shown, what is chosen is asked for. All rules are the server's.

import { Seat, complain, remember, remembered, say } from "./seat.js";

const $ = (id) => document.getElementById(id);
const seat = new Seat();
const SIGNS = {
  X: "M20 20L80 80M80 20L20 80",
  O: "M50 15a35 35 0 1 1 0 70a35 35 0 1 1 0 -70",
};
let state = null;
let chosen = 4; // where the focus is, or was

const squares = Array.from({ length: 9 }, (_, cell) => {
  const button = document.createElement("button");
  button.type = "button";
  button.dataset.cell = cell;
  button.addEventListener("click", () => act("move", { cell }));
  button.addEventListener("focus", () => { chosen = cell; });
  return button;
});
$("grid").append(...squares);

function drawn(sign) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 100 100");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", SIGNS[sign]);
  svg.append(path);
  return svg;
}

function show(found) {
  state = found;
  const { cells, values, result, score } = state;
  squares.forEach((button, cell) => {
    const sign = cells[cell], value = $("values").checked ? values[cell] : null;
    const line = result?.line?.includes(cell);
    button.className = [sign, line ? "won" : "", value ? `worth-${value}` : ""].filter(Boolean).join(" ");
    button.setAttribute("aria-disabled", String(Boolean(sign) || result !== null)); // it keeps the focus
    button.tabIndex = cell === chosen ? 0 : -1;
    const where = `Row ${Math.floor(cell / 3) + 1}, column ${(cell % 3) + 1}`;
    button.setAttribute("aria-label", `${where}, ${sign || "free"}${value ? `, worth a ${value}` : ""}`);
    if (sign) button.replaceChildren(drawn(sign));
    else if (value) {
      const badge = document.createElement("span");
      badge.className = `value ${value}`;
      badge.textContent = value;
      button.replaceChildren(badge);
    } else button.replaceChildren();
  });
  $("player").textContent = state.player;
  $("score").textContent = `won ${score.you}, drawn ${score.draws}, lost ${score.opponent}`;
  $("undo").disabled = !state.can_undo;
  say($("status"), told());
  document.body.dataset.revision = state.revision;
}

function told() {
  if (state.result === null) {
    const number = state.cells.filter((sign) => sign).length;
    return number < 2 ? `You are ${state.player}: choose a square.` : "Your move.";
  }
  return { you: "You win.", opponent: "You lose; undo shows what was better." }[state.result.winner] ?? "A draw: nobody erred at the end.";
}

async function act(what, fields = {}) {
  if (state === null || (what === "move" && (state.result !== null || state.cells[fields.cell]))) return;
  const answer = await seat.act(what, fields);
  if (answer === null) return;
  complain(answer.complaint);
  if (answer.state) show(answer.state);
}

const WAYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEYS = {
  u: () => $("undo").disabled || act("undo"),
  h: () => $("values").click(),
  x: () => act("new", { player: "X" }),
  o: () => act("new", { player: "O" }),
};

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || state === null) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const onGrid = event.target.dataset.cell !== undefined;
  if (Object.hasOwn(WAYS, key) && (onGrid || event.target === document.body)) {
    event.preventDefault();
    const [right, down] = onGrid ? WAYS[key] : [0, 0];
    const column = (chosen % 3 + right + 3) % 3, row = (Math.floor(chosen / 3) + down + 3) % 3;
    squares[chosen].tabIndex = -1;
    squares[3 * row + column].tabIndex = 0;
    squares[3 * row + column].focus();
  } else if (/^[1-9]$/.test(key)) act("move", { cell: Number(key) - 1 });
  else if (Object.hasOwn(KEYS, key) && !event.repeat) KEYS[key]();
});

$("undo").addEventListener("click", () => act("undo"));
$("as-x").addEventListener("click", () => act("new", { player: "X" }));
$("as-o").addEventListener("click", () => act("new", { player: "O" }));
$("values").checked = remembered("values", "") === "on";
$("values").addEventListener("change", () => {
  remember("values", $("values").checked ? "on" : "");
  if (state !== null) show(state);
});

try {
  show((await seat.resume()).state);
} catch (error) {
  complain(error.message);
  say($("status"), "There is no game.");
}
