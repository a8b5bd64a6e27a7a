// The board as SVG: what lies where, what is marked, and how checkers move. It knows no rules.

const SVG = "http://www.w3.org/2000/svg";
const TALLEST = 5; // checkers of a stack that are told apart
const PHONE = window.matchMedia("(max-width: 30rem) and (orientation: portrait)");
const SPOTS = [...Array.from({ length: 24 }, (_, i) => String(24 - i)), "bar", "off"];
const PIPS = { 1: [4], 2: [0, 8], 3: [0, 4, 8], 4: [0, 2, 6, 8], 5: [0, 2, 4, 6, 8], 6: [0, 2, 3, 5, 6, 8] };

function make(name, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// Lengths of a board that lies, and of one that stands upright on a phone, where checkers are half as large again: the
// same board with less rim, turned by a quarter, and with the checkers of a full stack lying on each other.
function lengths({ column, rim, left, bar, radius, span, gap, tray, between }) {
  const stack = (span + 1) * 2 * radius; // of five: they reach over `span` diameters
  const height = 2 * (rim + 2 + stack) + gap, right = left + 12 * column + bar;
  return { column, rim, left, bar, radius, span, stack, height, right, tray, trayLeft: right + between,
    width: right + between + tray + left, middle: height / 2 };
}
const LYING = lengths({ column: 46, rim: 34, left: 18, bar: 52, radius: 21.5, span: 4, gap: 78, tray: 50, between: 12 });
const STANDING = lengths({ column: 46, rim: 24, left: 8, bar: 44, radius: 22, span: 3.4, gap: 46, tray: 36, between: 8 });
let at = LYING;

function columnOf(point) { // its middle
  const i = point > 12 ? point - 13 : 12 - point;
  return at.left + at.column * (i + 0.5) + (i >= 6 ? at.bar : 0);
}

// Where the checker number i of n on a spot has its middle; spots are "1" to "24", "bar" and "off".
function placeOf(who, spot, i, n) {
  const down = who === "you" ? -1 : 1; // from one's own rim inwards
  if (spot === "off") {
    return [at.trayLeft + at.tray / 2, (who === "you" ? at.height - at.rim - 9 : at.rim + 9) + down * i * offStep()];
  }
  const step = 2 * at.radius * Math.min(1, (spot === "bar" ? 2.5 : at.span) / Math.max(n - 1, 1));
  if (spot === "bar") return [at.left + 6 * at.column + at.bar / 2, at.middle - down * (at.radius + 34 + i * step)];
  const point = Number(spot);
  const inwards = at.radius + 2 + i * step;
  return [columnOf(point), point > 12 ? at.rim + inwards : at.height - at.rim - inwards];
}

function offStep() { // fifteen fill a tray
  return (at.middle - at.rim - 24 - 18) / 14;
}

function countOf(side, spot) {
  return spot === "bar" ? side.bar : spot === "off" ? side.off : side.points[Number(spot) - 1];
}

function changed(side, spot, by) {
  const other = { ...side, points: [...side.points] };
  if (spot === "bar" || spot === "off") other[spot] += by;
  else other.points[Number(spot) - 1] += by;
  return other;
}

export class Board {
  constructor(svg, onChoose) {
    this.svg = svg;
    this.onChoose = onChoose;
    this.lay();
    PHONE.addEventListener("change", () => this.again());
  }

  // Builds the board as the screen has room for it.
  lay() {
    const stands = PHONE.matches;
    at = stands ? STANDING : LYING;
    this.layers = {};
    this.svg.setAttribute("viewBox", stands ? `0 0 ${at.height} ${at.width}` : `0 0 ${at.width} ${at.height}`);
    this.turned = make("g", stands ? { transform: `translate(${at.height} 0) rotate(90)` } : {});
    this.svg.replaceChildren(this.turned);
    this.drawGround();
    for (const name of ["marks", "checkers", "ghosts", "dice", "spots"]) {
      this.layers[name] = make("g", name === "spots" ? {} : { "aria-hidden": "true", class: name });
      this.turned.append(this.layers[name]);
    }
    this.spots = Object.fromEntries(SPOTS.map((spot) => [spot, this.makeSpot(spot)]));
    this.layers.spots.append(...SPOTS.map((spot) => this.spots[spot]));
  }

  again() {
    this.lay();
    if (this.counts) this.show(this.counts);
    if (this.marked) this.mark(...this.marked);
    if (this.dice) this.showDice(...this.dice);
  }

  // A text with its middle at (x, y), upright however the board lies.
  text(x, y, name, words) {
    const turn = at === STANDING ? ` rotate(-90)` : "";
    return make("text", { transform: `translate(${x} ${y})${turn}`, "dominant-baseline": "central", class: name }, words);
  }

  drawGround() {
    const ground = make("g", { "aria-hidden": "true" });
    const field = (x, width) => make("rect", { x, y: at.rim, width, height: at.height - 2 * at.rim, class: "field", rx: 3 });
    ground.append(
      make("rect", { width: at.width, height: at.height, rx: 14, class: "frame" }),
      make("rect", { x: 5, y: 5, width: at.width - 10, height: at.height - 10, rx: 10, class: "edge" }),
      field(at.left, 6 * at.column), field(at.left + 6 * at.column + at.bar, 6 * at.column),
      ...[at.rim, at.middle + 24].map((y) => make("rect", {
        x: at.trayLeft, y, width: at.tray, height: at.middle - at.rim - 24, rx: 4, class: "tray",
      })),
    );
    this.triangles = {};
    for (let point = 1; point <= 24; point += 1) {
      const x = columnOf(point), top = point > 12;
      const [rim, tip] = top ? [at.rim, at.rim + at.stack] : [at.height - at.rim, at.height - at.rim - at.stack];
      const half = at.column / 2 - 1.5;
      this.triangles[point] = make("path", {
        d: `M${x - half} ${rim}L${x + half} ${rim}L${x} ${tip}Z`, class: `triangle ${point % 2 ? "odd" : "even"}`,
      });
      const number = this.text(x, top ? at.rim / 2 : at.height - at.rim / 2, "number", String(point));
      ground.append(this.triangles[point], number);
    }
    this.turned.append(ground);
  }

  makeSpot(spot) {
    const half = at.middle - at.rim;
    let box;
    if (spot === "off") box = { x: at.trayLeft - 4, y: at.middle + 20, width: at.tray + 8, height: half - 16 };
    else if (spot === "bar") {
      box = { x: at.left + 6 * at.column + 1, y: at.middle + 6, width: at.bar - 2, height: half - 6 };
    } else {
      const y = Number(spot) > 12 ? at.rim : at.middle;
      box = { x: columnOf(Number(spot)) - at.column / 2, y, width: at.column, height: half };
    }
    const element = make("rect", { ...box, rx: 5, class: "spot", role: "button", "data-spot": spot, tabindex: -1 });
    element.addEventListener("click", () => this.onChoose(spot));
    return element;
  }

  // What lies where. `counts` has the sides "you" and "agent", each with points, bar and off.
  show(counts) {
    this.counts = counts;
    this.layers.checkers.replaceChildren();
    this.tops = { you: {}, agent: {} };
    for (const who of ["agent", "you"]) {
      for (const spot of SPOTS) this.drawStack(who, spot, countOf(counts[who], spot));
    }
  }

  drawStack(who, spot, n) {
    for (let i = 0; i < n; i += 1) {
      const [x, y] = placeOf(who, spot, i, n);
      const checker = make("g", { class: `checker ${who}`, transform: `translate(${x} ${y})` });
      const body = make("g"); // moved while it travels
      if (spot === "off") {
        body.append(make("rect", { x: -at.tray / 2 + 4, y: -6, width: at.tray - 8, height: 12, rx: 3, class: "disc" }));
      } else {
        body.append(make("circle", { r: at.radius, class: "disc" }), make("circle", { r: at.radius * 0.62, class: "groove" }));
        const shown = spot === "bar" ? 3 : TALLEST;
        if (i === n - 1 && n > shown) body.append(this.text(0, 0, "count", String(n)));
      }
      checker.append(body);
      this.layers.checkers.append(checker);
      if (i === n - 1) this.tops[who][spot] = { body, x, y };
    }
  }

  // Plays steps one after the other, from `before`.
  async play(before, steps, milliseconds) {
    this.show(before);
    for (const step of steps) {
      const { who, hit } = step;
      const source = String(step.source), target = String(step.target), other = who === "you" ? "agent" : "you";
      const from = this.tops[who][source];
      const counts = { ...this.counts };
      counts[who] = changed(changed(counts[who], source, -1), target, 1);
      const hitFrom = hit ? this.tops[other][target] : null;
      if (hit) counts[other] = changed(changed(counts[other], target, -1), "bar", 1);
      this.show(counts);
      if (milliseconds === 0) continue;
      const travels = [this.travel(this.tops[who][target], from, milliseconds)];
      if (hitFrom) travels.push(this.travel(this.tops[other].bar, hitFrom, milliseconds));
      await Promise.all(travels);
    }
  }

  travel(top, from, milliseconds) {
    if (!top || !from) return Promise.resolve();
    const start = `translate(${from.x - top.x}px, ${from.y - top.y}px)`;
    top.body.closest(".checker").parentNode.append(top.body.closest(".checker")); // above the others
    return top.body.animate([{ transform: start }, { transform: "none" }], {
      duration: milliseconds, easing: "ease-in-out",
    }).finished;
  }

  // Which spots can be chosen: `sources`, or with one selected its `targets` as well.
  mark(sources, selected, targets, describe) {
    this.marked = [sources, selected, targets, describe];
    const { marks, ghosts } = this.layers;
    marks.replaceChildren();
    ghosts.replaceChildren();
    for (const [point, triangle] of Object.entries(this.triangles)) {
      triangle.classList.toggle("target", targets.includes(point));
    }
    for (const spot of SPOTS) {
      const role = spot === selected ? "selected" : targets.includes(spot) ? "target"
        : sources.includes(spot) ? "source" : "";
      const element = this.spots[spot];
      element.setAttribute("class", `spot ${role}`);
      element.setAttribute("tabindex", role ? 0 : -1);
      element.setAttribute("aria-disabled", String(!role));
      element.setAttribute("aria-label", describe(spot, role));
      if (role === "selected") element.setAttribute("aria-pressed", "true");
      else element.removeAttribute("aria-pressed");
      const top = this.tops.you[spot];
      if (role === "target") this.drawGhost(spot);
      else if (role && top) ghosts.append(make("circle", { cx: top.x, cy: top.y, r: at.radius + 1, class: `ring ${role}` }));
    }
  }

  drawGhost(spot) {
    if (spot === "off") {
      this.layers.ghosts.append(make("rect", {
        x: at.trayLeft, y: at.middle + 24, width: at.tray, height: at.middle - at.rim - 24, rx: 4, class: "ghost",
      }));
      return;
    }
    const n = countOf(this.counts.you, spot);
    const facing = countOf(this.counts.agent, spot);
    const [x, y] = placeOf("you", spot, n + facing, n + facing + 1);
    this.layers.ghosts.append(make("circle", { cx: x, cy: y, r: at.radius - 5, class: "ghost" }));
  }

  // Dice as [{value, used}], the visitor's on the right and the agent's on the left.
  showDice(yours, agents) {
    this.dice = [yours, agents];
    const half = 3 * at.column;
    const dice = [[yours, at.right - half, "you"], [agents, at.left + half, "agent"]];
    this.layers.dice.replaceChildren(...dice.flatMap(([row, middle, who]) => row.map((die, i) => {
      const x = middle + (i - (row.length - 1) / 2) * 52;
      const dots = PIPS[die.value].map((place) => make("circle", {
        cx: ((place % 3) - 1) * 11, cy: (Math.floor(place / 3) - 1) * 11, r: 4.2,
      }));
      const box = make("rect", { x: -20, y: -20, width: 40, height: 40, rx: 8 });
      return make("g", { class: `die ${who} ${die.used ? "used" : ""}`, transform: `translate(${x} ${at.middle})` }, box, ...dots);
    })));
  }

  // The nearest spot that can be chosen, in the direction of an arrow key; from nowhere, the first.
  next(spot, key) {
    const free = SPOTS.filter((one) => this.spots[one].getAttribute("tabindex") === "0");
    if (!this.spots[spot]) return free[0];
    const middle = (one) => {
      const box = this.spots[one].getBBox();
      return [box.x + box.width / 2, box.y + box.height / 2];
    };
    const [x, y] = middle(spot);
    const [right, down] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
    const [dx, dy] = at === STANDING ? [down, -right] : [right, down];
    let best, least = Infinity;
    for (const one of free) {
      const [toX, toY] = middle(one);
      const along = (toX - x) * dx + (toY - y) * dy, across = Math.abs((toX - x) * dy) + Math.abs((toY - y) * dx);
      if (one !== spot && along > 1 && along + 3 * across < least) [best, least] = [one, along + 3 * across];
    }
    return best ?? free[(free.indexOf(spot) + (dx + dy > 0 ? 1 : free.length - 1)) % free.length];
  }

  focus(spot) {
    this.spots[spot]?.focus();
  }
}
