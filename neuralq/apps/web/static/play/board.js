// The board as SVG: what lies where, what is marked, and how checkers move. It knows no rules.

const SVG = "http://www.w3.org/2000/svg";
const COLUMN = 46, RIM = 34, LEFT = 18, BAR_WIDTH = 52, RADIUS = 21.5;
const HEIGHT = 580, RIGHT = LEFT + 12 * COLUMN + BAR_WIDTH, TRAY = RIGHT + 12, TRAY_WIDTH = 50;
const WIDTH = TRAY + TRAY_WIDTH + LEFT;
const MIDDLE = HEIGHT / 2, STACK = 5 * 2 * RADIUS, TALLEST = 5;
const SPOTS = [...Array.from({ length: 24 }, (_, i) => String(24 - i)), "bar", "off"];
const PIPS = { 1: [4], 2: [0, 8], 3: [0, 4, 8], 4: [0, 2, 6, 8], 5: [0, 2, 4, 6, 8], 6: [0, 2, 3, 5, 6, 8] };

function make(name, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function columnOf(point) { // its middle
  const i = point > 12 ? point - 13 : 12 - point;
  return LEFT + COLUMN * (i + 0.5) + (i >= 6 ? BAR_WIDTH : 0);
}

// Where the checker number i of n on a spot has its middle; spots are "1" to "24", "bar" and "off".
function placeOf(who, spot, i, n) {
  const down = who === "you" ? -1 : 1; // from one's own rim inwards
  if (spot === "off") {
    return [TRAY + TRAY_WIDTH / 2, (who === "you" ? HEIGHT - RIM - 9 : RIM + 9) + down * i * 14.5];
  }
  const step = 2 * RADIUS * Math.min(1, (spot === "bar" ? 2.5 : TALLEST - 1) / Math.max(n - 1, 1));
  if (spot === "bar") return [LEFT + 6 * COLUMN + BAR_WIDTH / 2, MIDDLE - down * (RADIUS + 34 + i * step)];
  const point = Number(spot);
  const inwards = RADIUS + 2 + i * step;
  return [columnOf(point), point > 12 ? RIM + inwards : HEIGHT - RIM - inwards];
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
    this.layers = {};
    svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    this.drawGround();
    for (const name of ["marks", "checkers", "ghosts", "dice", "spots"]) {
      this.layers[name] = make("g", name === "spots" ? {} : { "aria-hidden": "true", class: name });
      svg.append(this.layers[name]);
    }
    this.spots = Object.fromEntries(SPOTS.map((spot) => [spot, this.makeSpot(spot)]));
    this.layers.spots.append(...SPOTS.map((spot) => this.spots[spot]));
  }

  drawGround() {
    const ground = make("g", { "aria-hidden": "true" });
    const field = (x, width) => make("rect", { x, y: RIM, width, height: HEIGHT - 2 * RIM, class: "field", rx: 3 });
    ground.append(
      make("rect", { width: WIDTH, height: HEIGHT, rx: 14, class: "frame" }),
      make("rect", { x: 5, y: 5, width: WIDTH - 10, height: HEIGHT - 10, rx: 10, class: "edge" }),
      field(LEFT, 6 * COLUMN), field(LEFT + 6 * COLUMN + BAR_WIDTH, 6 * COLUMN),
      ...[RIM, MIDDLE + 24].map((y) => make("rect", {
        x: TRAY, y, width: TRAY_WIDTH, height: MIDDLE - RIM - 24, rx: 4, class: "tray",
      })),
    );
    this.triangles = {};
    for (let point = 1; point <= 24; point += 1) {
      const x = columnOf(point), top = point > 12;
      const [rim, tip] = top ? [RIM, RIM + STACK] : [HEIGHT - RIM, HEIGHT - RIM - STACK];
      const half = COLUMN / 2 - 1.5;
      this.triangles[point] = make("path", {
        d: `M${x - half} ${rim}L${x + half} ${rim}L${x} ${tip}Z`, class: `triangle ${point % 2 ? "odd" : "even"}`,
      });
      const number = make("text", { x, y: top ? RIM - 11 : HEIGHT - RIM + 21, class: "number" }, String(point));
      ground.append(this.triangles[point], number);
    }
    this.svg.append(ground);
  }

  makeSpot(spot) {
    const half = MIDDLE - RIM;
    let box;
    if (spot === "off") box = { x: TRAY - 4, y: MIDDLE + 20, width: TRAY_WIDTH + 8, height: half - 16 };
    else if (spot === "bar") {
      box = { x: LEFT + 6 * COLUMN + 1, y: MIDDLE + 6, width: BAR_WIDTH - 2, height: half - 6 };
    } else {
      const y = Number(spot) > 12 ? RIM : MIDDLE;
      box = { x: columnOf(Number(spot)) - COLUMN / 2, y, width: COLUMN, height: half };
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
        body.append(make("rect", { x: -TRAY_WIDTH / 2 + 4, y: -6, width: TRAY_WIDTH - 8, height: 12, rx: 3, class: "disc" }));
      } else {
        body.append(make("circle", { r: RADIUS, class: "disc" }), make("circle", { r: RADIUS * 0.62, class: "groove" }));
        const shown = spot === "bar" ? 3 : TALLEST;
        if (i === n - 1 && n > shown) body.append(make("text", { y: 7, class: "count" }, String(n)));
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
      else if (role && top) ghosts.append(make("circle", { cx: top.x, cy: top.y, r: RADIUS + 1, class: `ring ${role}` }));
    }
  }

  drawGhost(spot) {
    if (spot === "off") {
      this.layers.ghosts.append(make("rect", {
        x: TRAY, y: MIDDLE + 24, width: TRAY_WIDTH, height: MIDDLE - RIM - 24, rx: 4, class: "ghost",
      }));
      return;
    }
    const n = countOf(this.counts.you, spot);
    const facing = countOf(this.counts.agent, spot);
    const [x, y] = placeOf("you", spot, n + facing, n + facing + 1);
    this.layers.ghosts.append(make("circle", { cx: x, cy: y, r: RADIUS - 5, class: "ghost" }));
  }

  // Dice as [{value, used}], the visitor's on the right and the agent's on the left.
  showDice(yours, agents) {
    const half = 3 * COLUMN;
    const dice = [[yours, RIGHT - half, "you"], [agents, LEFT + half, "agent"]];
    this.layers.dice.replaceChildren(...dice.flatMap(([row, middle, who]) => row.map((die, i) => {
      const x = middle + (i - (row.length - 1) / 2) * 52;
      const dots = PIPS[die.value].map((place) => make("circle", {
        cx: ((place % 3) - 1) * 11, cy: (Math.floor(place / 3) - 1) * 11, r: 4.2,
      }));
      const box = make("rect", { x: -20, y: -20, width: 40, height: 40, rx: 8 });
      return make("g", { class: `die ${who} ${die.used ? "used" : ""}`, transform: `translate(${x} ${MIDDLE})` }, box, ...dots);
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
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
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
