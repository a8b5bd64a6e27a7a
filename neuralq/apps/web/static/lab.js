// The page: what is chosen, the link that says so, the questions to the server, and what came back.

import { drawEigenvalues, drawErrors, drawWeights, isNearTheEdge, redrawAll, stale } from "./charts.js";
import { showNumbers } from "./numbers.js";
import { remedyTable } from "./remedies.js";
import { makeSlider } from "./sliders.js";
import { VERDICTS, bound, factor, list, short } from "./words.js";

const $ = (id) => document.getElementById(id);
const SHARED = { gamma: "gamma", step_size: "alpha", num_steps: "updates", num_seeds: "runs" }; // names in the link
const DEFAULTS = { num_steps: 1000, num_seeds: 20 };
const WAIT = 120; // milliseconds without a move before the server is asked

let lab; // what can be chosen
const chosen = { problem: "baird", method: "td", sampling: "expected", ...DEFAULTS, options: {} };
let moved = "gamma";
const sliders = {};
let optionSliders = {};
const latest = {}; // kind of question -> its AbortController; a newer one ends the older
let timer;
let diagnosis = null;
let ran = null;
const wantsCloseup = { chosen: false }; // until the visitor decides, the picture does

const problemOf = () => lab.problems.find((one) => one.name === chosen.problem);
const methodOf = () => lab.methods.find((one) => one.name === chosen.method);
const fits = (method, problem) => (!method.pairs || problem.pairs) && (!problem.nonlinear || method.name === "td");

// ---- questions

async function ask(kind, body) {
  latest[kind]?.abort();
  const mine = new AbortController();
  latest[kind] = mine;
  let reply;
  try {
    reply = await fetch(`/api/${kind.split(" ")[0]}`, {
      method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body), signal: mine.signal,
    });
    const found = await reply.json();
    if (!reply.ok) throw Object.assign(new Error(found.error), { status: reply.status });
    return found;
  } catch (error) {
    if (mine.signal.aborted) return null;
    if (reply === undefined) throw new Error("the server does not answer; is it still running?");
    throw error;
  }
}

const place = () => ({ problem: chosen.problem, gamma: chosen.gamma, step_size: chosen.step_size });
const setting = () => ({ ...place(), method: chosen.method, sampling: chosen.sampling, options: { ...chosen.options } });

function later(what) {
  clearTimeout(timer);
  timer = setTimeout(what, WAIT);
}

function changed(name) {
  if (name !== undefined) moved = name;
  round += 1; // answers to what was asked before are no longer of interest
  forget();
  writeLink();
  later(refresh);
}

let round = 0;
let complaints = []; // about the link

async function refresh() {
  round += 1;
  const mine = round;
  const errors = complaints;
  complaints = [];
  diagnosis = null;
  ran = null;
  const slow = setTimeout(() => progress("computing…"), 250);
  const mean = setTimeout(() => showMean(mine), 500);
  const exact = async () => {
    const found = await ask("diagnose", setting()).catch((error) => {
      errors.push(error.message);
      return error.status >= 500 && diagnosis !== null ? diagnosis : undefined; // then the mean stays
    });
    clearTimeout(mean);
    latest["diagnose mean"]?.abort();
    if (mine !== round || found === null) return;
    diagnosis = found ?? null;
    showDiagnosis(found);
  };
  const trained = async () => {
    const went = await ask("run", { ...setting(), num_steps: chosen.num_steps, num_seeds: chosen.num_seeds })
      .catch((error) => { errors.push(error.message); return null; });
    if (mine !== round) return;
    ran = went;
    showRun();
  };
  await Promise.all([exact(), trained()]);
  clearTimeout(slow);
  if (mine !== round) return;
  progress("");
  $("error").hidden = errors.length === 0;
  $("error").textContent = [...new Set(errors)].join(" ");
  showRun(); // once more, with the predicted growth
}

// Second moments may take a while; the mean, which does not, is shown first and says so.
async function showMean(mine) {
  if (chosen.sampling === "expected") return;
  const found = await ask("diagnose mean", { ...setting(), sampling: "expected" }).catch(() => null);
  if (found && mine === round && diagnosis === null) {
    diagnosis = found;
    showDiagnosis(found);
    progress("This is the mean. How single runs scatter is still being computed…");
  }
}

function progress(text) {
  $("progress").hidden = text === "";
  $("progress-text").textContent = text;
  $("results").setAttribute("aria-busy", String(text !== ""));
}

// ---- answers

function say(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text; // an unchanged verdict is not read out again
}

function showDiagnosis(found) {
  if (found === undefined) {
    $("verdict").dataset.verdict = "none";
    say("verdict-sign", "–");
    say("verdict-word", "no verdict for this choice");
    say("verdict-number", "");
    say("explanation", "The message says why.");
    $("numbers").replaceChildren();
    stale("eigenvalues");
    return;
  }
  const [kind, sign, word] = VERDICTS[found.verdict];
  $("verdict").dataset.verdict = kind;
  say("verdict-sign", sign);
  say("verdict-word", word);
  say("verdict-number", `ρ = ${factor(found.spectral_radius)}${found.local ? ", near the initial weights" : ""}`);
  say("explanation", found.explanation);
  if (!wantsCloseup.chosen) $("closeup").checked = isNearTheEdge(found.eigenvalues);
  drawEigenvalues(found.eigenvalues, $("closeup").checked);
  $("closeup").onchange = () => {
    wantsCloseup.chosen = true;
    drawEigenvalues(found.eigenvalues, $("closeup").checked);
  };
  showNumbers($("numbers"), found);
}

function showRun() {
  if (ran === null) {
    stale("errors");
    stale("weights");
    $("errors-note").textContent = $("weights-note").textContent = "No run for this choice.";
    return;
  }
  drawErrors(ran, predicted());
  drawWeights(ran);
  $("errors-note").textContent = ran.num_diverged === 0 ? (ran.num_seeds > 1 ? `${ran.num_seeds} runs.` : "")
    : ran.num_seeds > 1 ? `${ran.num_diverged} of ${ran.num_seeds} runs left every bound.` : "The run left every bound and was stopped.";
  const part = ran.num_weights > ran.weights.length ? `The first ${ran.weights.length} of ${ran.num_weights} weights` : "All weights";
  $("weights-note").textContent = ran.num_seeds > 1 ? `${part}, of the first run.` : `${part}.`;
}

// The predicted growth as a line that ends where the run does.
function predicted() {
  if (diagnosis === null || diagnosis.verdict !== "diverges" || diagnosis.spectral_radius <= 1) return null;
  const row = ran.rmsve[1];
  let last = row.length - 1;
  while (last > 0 && (row[last] === null || (ran.num_diverged > 0 && row[last] >= row[row.length - 1]))) last -= 1;
  if (last < 1 || !(row[last] > 0)) return null;
  const first = Math.floor(last / 3);
  const rate = Math.log(diagnosis.spectral_radius) / diagnosis.updates;
  const x = ran.steps.slice(first, last + 1);
  return { x, y: x.map((step) => row[last] * Math.exp(rate * (step - ran.steps[last]))) };
}

// ---- the edge, and remedies

const labelOf = (name) => {
  const field = lab.fields[name] && !(name in chosen.options) ? lab.fields[name] : methodOf().options.find((one) => one.name === name);
  return field.label.split(",")[0];
};

function forget() {
  const method = methodOf();
  if (!method.critical.includes(moved)) moved = "gamma";
  $("find-critical").textContent = `Critical value of ${labelOf(moved)}`;
  for (const kind of ["critical", "prescribe"]) latest[kind]?.abort();
  if ($("critical").dataset.of !== edgeKey()) $("critical").replaceChildren();
  if ($("help").dataset.of !== JSON.stringify(place())) {
    $("help").replaceChildren();
    $("help-status").textContent = "";
  }
  for (const id of ["find-critical", "find-help"]) $(id).disabled = false;
}

// All that the answer depends on: the moved parameter itself does not matter to where its edge is.
function edgeKey() {
  const body = { ...setting(), parameter: moved };
  if (moved in body.options) body.options[moved] = 0;
  else body[moved] = 0;
  return JSON.stringify(body);
}

async function press(id, status, kind, body, show) {
  $(id).disabled = true;
  const waiting = document.createElement("p");
  waiting.textContent = "computing…";
  $(status).replaceChildren(waiting);
  try {
    const found = await ask(kind, body);
    if (found === null) return $(status).replaceChildren();
    show(found);
  } catch (error) {
    waiting.textContent = `This could not be computed: ${error.message}`;
  }
  $(id).disabled = false;
}

function findCritical() {
  const key = edgeKey();
  press("find-critical", "critical", "critical", { ...setting(), parameter: moved }, (found) => {
    const lines = found.parameter === "step_size" ? stepLines(found) : rangeLines(found);
    $("critical").replaceChildren(...lines.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
    $("critical").dataset.of = key;
  });
}

function stepLines(found) {
  const lines = [`The mean converges for ${bound(found.bound)}.`];
  const second = found.bound_second_moment;
  if (second.value !== null || second.every) lines.push(`The variance settles for ${bound(second)}.`);
  return lines;
}

function rangeLines(found) {
  const name = labelOf(found.parameter);
  const told = (one, when) => {
    const [low, high] = one.range.map((value) => short(value, 4));
    if (one.boundaries.length === 0) {
      return `${when} the mean ${one.stable.length ? "converges" : "does not converge"} for every ${name} from ${low} to ${high}.`;
    }
    const sets = one.stable.map(([from, to]) => `from ${short(from, 6)} to ${short(to, 6)}`);
    const where = list(one.boundaries.map((value) => short(value, 8)));
    return `${when} stability of the mean changes at ${name} = ${where}. It converges ${list(sets) || "nowhere else"} (looked at from ${low} to ${high}).`;
  };
  const lines = [told(found, `With α = ${short(chosen.step_size, 6)},`)];
  if (found.limit) lines.push(told(found.limit, "With ever smaller steps,"));
  return lines;
}

function findHelp() {
  const key = JSON.stringify(place());
  $("help").replaceChildren();
  press("find-help", "help-status", "prescribe", place(), ({ remedies }) => {
    $("help-status").textContent = remedies.length ? `${remedies.length} remedies.` : "Nothing is needed: TD(0), or the problem's own control method, converges here.";
    $("help").replaceChildren(...(remedies.length ? [remedyTable(remedies, tryRemedy)] : []));
    $("help").dataset.of = key;
  });
}

function tryRemedy(remedy) {
  Object.assign(chosen, { method: remedy.method, options: { ...remedy.options }, step_size: remedy.step_size });
  showChoice();
  changed();
  $("results").scrollIntoView();
}

// ---- what is chosen

function fill(select, groups) {
  select.replaceChildren(...groups.map(([name, value, disabled]) => Object.assign(document.createElement("option"), { textContent: name, value, disabled })));
}

function showChoice() {
  const problem = problemOf();
  const method = methodOf();
  $("problem").value = chosen.problem;
  fill($("method"), lab.methods.map((one) => [one.title, one.name, !fits(one, problem)]));
  $("method").value = chosen.method;
  $("problem-note").textContent = `${problem.known} ${problem.source ? `(${problem.source})` : ""}`;
  $("method-note").textContent = `${method.note ? `${method.note}. ` : ""}${method.source}`;
  for (const [name, slider] of Object.entries(sliders)) slider.set(chosen[name]);
  optionSliders = Object.fromEntries(method.options.map((field) => [field.name, makeSlider(`option-${field.name}`, field, (_, value) => {
    chosen.options[field.name] = value;
    changed(field.name);
  })]));
  for (const [name, slider] of Object.entries(optionSliders)) slider.set(chosen.options[name]);
  $("option-sliders").replaceChildren(...Object.values(optionSliders).map((one) => one.element));
  if (!method.sampled) chosen.sampling = "expected";
  for (const radio of document.querySelectorAll("#sampling input")) {
    radio.checked = radio.value === chosen.sampling;
    radio.disabled = !method.sampled && radio.value !== "expected";
  }
  sliders.num_seeds.element.hidden = chosen.sampling === "expected";
  sliders.num_seeds.element.style.display = chosen.sampling === "expected" ? "none" : "";
}

function useMethod(name) {
  chosen.method = name;
  chosen.options = Object.fromEntries(methodOf().options.map((one) => [one.name, one.value]));
}

function useProblem(name) {
  chosen.problem = name;
  const problem = problemOf();
  chosen.gamma = problem.gamma;
  chosen.step_size = problem.step_size;
  if (!fits(methodOf(), problem) || problem.method !== "td") useMethod(problem.method);
}

function writeLink() {
  const link = new URLSearchParams({ problem: chosen.problem, method: chosen.method, sampling: chosen.sampling });
  for (const [name, short_name] of Object.entries(SHARED)) link.set(short_name, chosen[name]);
  for (const [name, value] of Object.entries(chosen.options)) link.set(name, value);
  history.replaceState(null, "", `#${link}`);
}

// What the link says, as far as it means something; the server refuses numbers out of range and says so.
function readLink() {
  const link = new URLSearchParams(location.hash.slice(1));
  const asked = { problem: link.get("problem"), method: link.get("method") };
  if (lab.problems.some((one) => one.name === asked.problem)) useProblem(asked.problem);
  else if (asked.problem) complaints.push(`The link names no problem of the lab: ${asked.problem}.`);
  const method = lab.methods.find((one) => one.name === asked.method);
  if (method && fits(method, problemOf())) useMethod(method.name);
  else if (asked.method) complaints.push(`The link names no method for this problem: ${asked.method}.`);
  if (lab.samplings.includes(link.get("sampling"))) chosen.sampling = link.get("sampling");
  const number = (name, otherwise) => (link.get(name) && Number.isFinite(Number(link.get(name))) ? Number(link.get(name)) : otherwise);
  for (const [name, short_name] of Object.entries(SHARED)) chosen[name] = number(short_name, chosen[name]);
  for (const name of Object.keys(chosen.options)) chosen.options[name] = number(name, chosen.options[name]);
}

async function copyLink() {
  try {
    await navigator.clipboard.writeText(location.href);
    $("shared").textContent = "copied";
  } catch {
    $("shared").textContent = "copy it from the address bar";
  }
  setTimeout(() => { $("shared").textContent = ""; }, 3000);
}

function listen() {
  $("problem").addEventListener("change", (event) => { useProblem(event.target.value); showChoice(); changed("gamma"); });
  $("method").addEventListener("change", (event) => { useMethod(event.target.value); showChoice(); changed("gamma"); });
  $("sampling").addEventListener("change", (event) => { chosen.sampling = event.target.value; showChoice(); changed(); });
  $("reset").addEventListener("click", () => { useProblem(chosen.problem); useMethod(chosen.method); Object.assign(chosen, DEFAULTS); showChoice(); changed("gamma"); });
  $("share").addEventListener("click", copyLink);
  $("find-critical").addEventListener("click", findCritical);
  $("find-help").addEventListener("click", findHelp);
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  window.addEventListener("hashchange", () => { readLink(); showChoice(); forget(); later(refresh); });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
}

async function begin() {
  try {
    lab = await (await fetch("/api/lab")).json();
  } catch {
    $("error").hidden = false;
    $("error").textContent = "The server does not answer; is it still running?";
    return;
  }
  fill($("problem"), lab.problems.map((one) => [one.title, one.name, false]));
  for (const [name, holder] of [["gamma", "shared"], ["step_size", "shared"], ["num_steps", "run"], ["num_seeds", "run"]]) {
    sliders[name] = makeSlider(name, lab.fields[name], (_, value) => { chosen[name] = value; changed(name); });
    $(`${holder}-sliders`).append(sliders[name].element);
  }
  useProblem(chosen.problem);
  useMethod(chosen.method);
  readLink();
  showChoice();
  listen();
  forget();
  refresh();
}

begin();
