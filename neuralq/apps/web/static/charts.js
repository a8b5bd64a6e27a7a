// The three charts, drawn by plotly in the colours of the style sheet.

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const CONFIG = { displayModeBar: false, responsive: true, showTips: false };
const drawn = new Map(); // element id -> how to draw it again in other colours

function layout(more) {
  const axis = { gridcolor: colour("--grid"), zerolinecolor: colour("--line"), linecolor: colour("--line"), automargin: true };
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", dragmode: false, hovermode: "closest",
    font: { color: colour("--ink"), size: 12 }, margin: { l: 48, r: 12, t: 8, b: 40 },
    hoverlabel: { bgcolor: colour("--card"), font: { color: colour("--ink") } },
    legend: { orientation: "h", x: 0, y: -0.22, yanchor: "top", font: { size: 11 } },
    ...more,
    xaxis: { ...axis, ...more.xaxis }, yaxis: { ...axis, ...more.yaxis },
  };
}

function draw(id, label, make) {
  const element = document.getElementById(id);
  const redraw = () => {
    const [traces, its] = make();
    window.Plotly.react(element, traces, layout(its), CONFIG);
  };
  drawn.set(id, redraw);
  element.setAttribute("aria-label", label);
  element.closest("figure").removeAttribute("data-stale");
  redraw();
}

export function stale(id) {
  document.getElementById(id).closest("figure").setAttribute("data-stale", "");
}

export function redrawAll() {
  for (const redraw of drawn.values()) redraw();
}

function view(points, closeup) {
  if (!closeup || points.length === 0) {
    const reach = 1.12 * Math.max(1, ...points.map(([re, im]) => Math.hypot(re, im)));
    return { x: [-reach, reach], y: [-reach, reach] };
  }
  const [re, im] = points[0]; // the leading one, in the middle of a window that reaches over the edge
  const modulus = Math.hypot(re, im);
  const half = Math.max(4 * Math.abs(modulus - 1), 1e-9);
  return { x: [re - half, re + half], y: [im - half, im + half] };
}

// Whether the leading eigenvalue lies so near the circle that only a close-up tells on which side.
export function isNearTheEdge(points) {
  if (points.length === 0) return false;
  const off = Math.abs(Math.hypot(...points[0]) - 1);
  return off > 0 && off < 0.03;
}

export function drawEigenvalues(points, closeup) {
  const size = points.map(([re, im]) => Math.hypot(re, im));
  const outside = size.filter((one) => one > 1).length;
  const label = points.length === 0 ? "Eigenvalues: nothing moves"
    : `Eigenvalues in the complex plane: ${points.length}, of which ${outside} outside the stability disc; the largest modulus is ${Math.max(...size).toPrecision(6)}`;
  draw("eigenvalues", label, () => {
    const kinds = [["inside", (one) => one < 1, "circle", "--line-1"], ["on the edge or outside", (one) => one >= 1, "x", "--line-2"]];
    const traces = kinds.map(([name, holds, symbol, tint]) => {
      const kept = points.filter((_, i) => holds(size[i]));
      return {
        type: "scatter", mode: "markers", name, x: kept.map((one) => one[0]), y: kept.map((one) => one[1]),
        marker: { symbol, size: 10, color: colour(tint), line: { width: 1, color: colour("--card") } },
        text: kept.map(([re, im]) => `modulus ${Math.hypot(re, im).toPrecision(8)}`),
        hovertemplate: "%{x:.6g} + %{y:.6g} i<br>%{text}<extra></extra>",
      };
    });
    const seen = view(points, closeup);
    return [traces, {
      showlegend: true,
      shapes: [{ type: "circle", x0: -1, x1: 1, y0: -1, y1: 1, layer: "below", fillcolor: colour("--disc"), line: { color: colour("--line-1"), width: 1.5 } }],
      xaxis: { title: { text: "real part", standoff: 4 }, range: seen.x, nticks: 5 },
      yaxis: { title: { text: "imaginary part", standoff: 4 }, range: seen.y, scaleanchor: "x", constrain: "domain", nticks: 5 },
    }];
  });
}

const positive = (row) => row.map((one) => (one !== null && one > 0 ? one : null));

export function drawErrors(run, prediction) {
  const [low, median, high] = run.rmsve.map(positive);
  const label = `Errors over ${run.steps[run.steps.length - 1]} updates: the value error goes from ${run.rmsve[1][0]} to ${run.rmsve[1][run.rmsve[1].length - 1]}`;
  draw("errors", label, () => {
    const traces = [];
    if (run.num_seeds > 1) {
      const edge = { type: "scatter", mode: "lines", line: { width: 0 }, hoverinfo: "skip", showlegend: false };
      traces.push({ ...edge, x: run.steps, y: low });
      traces.push({ ...edge, x: run.steps, y: high, fill: "tonexty", fillcolor: colour("--disc"), showlegend: true, name: "10–90 % of runs" });
    }
    traces.push({ type: "scatter", mode: "lines", name: run.num_seeds > 1 ? "value error, median" : "value error", x: run.steps, y: median, line: { color: colour("--line-1"), width: 2.5 } });
    traces.push({ type: "scatter", mode: "lines", name: "projected Bellman error", x: run.steps, y: positive(run.rmspbe), line: { color: colour("--line-3"), width: 1.5, dash: "dash" } });
    if (prediction) {
      traces.push({ type: "scatter", mode: "lines", name: "predicted growth", ...prediction, line: { color: colour("--line-2"), width: 2, dash: "dot" } });
    }
    const seen = [...(run.num_seeds > 1 ? [...low, ...high] : median), ...positive(run.rmspbe)].filter((one) => one !== null);
    const decades = seen.length ? Math.log10(Math.max(...seen) / Math.min(...seen)) : 0;
    const dtick = decades >= 2 ? Math.ceil(decades / 6) : decades >= 0.5 ? "D2" : null; // D2: 1, 2, 5, 10, ...
    return [traces, {
      showlegend: true, xaxis: { title: { text: "updates", standoff: 4 }, nticks: 6 },
      yaxis: { type: "log", exponentformat: "power", nticks: 6, ...(dtick ? { dtick } : {}), minor: { showgrid: false } },
    }];
  });
}

// Weights that coincide share a line: [[indices], [values]] in the order of their first.
function together(rows) {
  const size = Math.max(...rows.flat().map((one) => Math.abs(one ?? 0)));
  const groups = [];
  rows.forEach((row, i) => {
    const same = groups.find(([, values]) => values.every((one, t) => one === row[t] || Math.abs(one - row[t]) <= 1e-9 * size));
    if (same) same[0].push(i + 1);
    else groups.push([[i + 1], row]);
  });
  return groups;
}

// 1, 2, 3, 5 as "w1–w3, w5".
function named(numbers) {
  const runs = [];
  for (const i of numbers) {
    if (runs.length && runs[runs.length - 1][1] === i - 1) runs[runs.length - 1][1] = i;
    else runs.push([i, i]);
  }
  return runs.map(([from, to]) => (from === to ? `w${from}` : `w${from}–w${to}`)).join(", ");
}

export function drawWeights(run) {
  const groups = together(run.weights);
  const label = `The first ${run.weights.length} of ${run.num_weights} weights over time; lines: ${groups.map(([numbers]) => named(numbers)).join("; ")}`;
  draw("weights", label, () => [
    groups.map(([numbers, row], i) => ({
      type: "scatter", mode: "lines", name: named(numbers), x: run.steps, y: row,
      line: { color: colour(`--line-${(i % 8) + 1}`), width: 2, dash: i < 8 ? "solid" : "dot" },
    })),
    { showlegend: true, xaxis: { title: { text: "updates", standoff: 4 }, nticks: 6 }, yaxis: { exponentformat: "power", nticks: 6 } },
  ]);
}
