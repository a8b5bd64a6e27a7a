// Remedies as a table: what to change, how far it is from the edge, how fast it is, where it ends, and a button.

import { short } from "./words.js";

const COLUMNS = ["Change", "Converges", "Updates to a tenth of the error", "Ends off by (RMS)", ""];

function cell(name, ...content) {
  const element = document.createElement(name);
  element.append(...content);
  return element;
}

// Updates as a number one reads at a glance.
function updates(remedy) {
  if (remedy.spectral_radius === 0) return "1";
  if (remedy.updates_to_tenth === null) return "no end";
  return remedy.updates_to_tenth < 1e6 ? Math.round(remedy.updates_to_tenth).toLocaleString("en") : short(remedy.updates_to_tenth, 2);
}

function row(remedy, onTry) {
  const scatters = Object.assign(cell("span", " ⚠ single runs scatter ever more widely"), { className: "note" });
  const tried = cell("td");
  if (remedy.method !== null) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: "Try it" });
    button.setAttribute("aria-label", `Try it: ${remedy.change}`);
    button.addEventListener("click", () => onTry(remedy));
    tried.append(button);
  }
  const head = cell("th", remedy.change, ...(remedy.scatters ? [scatters] : []));
  head.scope = "row";
  const numbers = [remedy.margin ?? "as it is", updates(remedy), remedy.error === null ? "unknown" : short(remedy.error, 3)];
  const cells = numbers.map((text, i) => {
    const one = cell("td", text);
    one.dataset.name = COLUMNS[i + 1];
    return one;
  });
  const line = cell("tr", head, ...cells, tried);
  line.title = remedy.text;
  return line;
}

export function remedyTable(remedies, onTry) {
  const heads = COLUMNS.map((text) => Object.assign(cell("th", text), { scope: "col" }));
  const table = cell("table", cell("thead", cell("tr", ...heads)), cell("tbody", ...remedies.map((one) => row(one, onTry))));
  table.className = "remedies";
  return table;
}
