// Turns in tables and in the record.

const percent = (chance) => (100 * chance).toFixed(1);
export const signed = (points) => `${points < 0 ? "−" : "+"}${Math.abs(points).toFixed(3)}`;

function element(name, text, attributes = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// The best turns, each with what the side that plays it expects.
export function turnTable(turns, caption) {
  const table = document.createElement("table");
  table.className = "turns";
  table.append(element("caption", caption));
  const head = document.createElement("tr");
  for (const [text, long] of [["Turn", ""], ["Equity", "points"], ["Win", "%"], ["Gammon", "%"], ["Lost g.", "% of lost gammons"]]) {
    head.append(element("th", text, long ? { scope: "col", title: long } : { scope: "col" }));
  }
  const body = document.createElement("tbody");
  turns.forEach((turn, i) => {
    const row = document.createElement("tr");
    if (i === 0) row.className = "best";
    row.append(
      element("th", turn.text, { scope: "row" }),
      element("td", signed(turn.equity)),
      ...[turn.win, turn.gammon, turn.lost_gammon].map((chance) => element("td", percent(chance))),
    );
    body.append(row);
  });
  const top = document.createElement("thead");
  top.append(head);
  table.append(top, body);
  return table;
}

// The turns of the game; for the visitor's own, how much worse than the best the agent thinks them.
export function record(list, entries) {
  const rows = entries.map((entry) => {
    const row = element("li", "", { class: entry.who });
    row.append(
      element("span", `${entry.who === "you" ? "You" : "Agent"} `, { class: "who" }),
      element("span", `${entry.dice.join("-")}: `, { class: "roll" }), element("span", entry.text),
    );
    if (entry.who === "you" && entry.rank !== null && entry.text !== "no move") {
      const ordinal = { 2: "2nd", 3: "3rd" }[entry.rank] ?? `no. ${entry.rank}`;
      const verdict = entry.rank === 1 ? "best" : `${ordinal}, −${entry.loss.toFixed(3)}`;
      row.append(element("span", ` ${verdict}`, { class: `verdict ${entry.rank === 1 ? "good" : entry.loss > 0.08 ? "bad" : ""}` }));
    }
    return row;
  });
  list.replaceChildren(...rows);
  list.scrollTop = list.scrollHeight;
}
