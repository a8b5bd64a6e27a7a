// A slider with a box for the exact value. Its positions are whole numbers; `spacing` says what values they stand for.

import { short } from "./words.js";

const STEPS = { linear: 200, log: 120, whole: 80 };

function values(field) {
  const { low, high, spacing } = field;
  const row = [];
  for (let i = 0; i <= STEPS[spacing]; i += 1) {
    const share = i / STEPS[spacing];
    if (spacing === "linear") row.push(Number((low + (high - low) * share).toPrecision(12)));
    else if (spacing === "log") row.push(Number((low * (high / low) ** share).toPrecision(3)));
    else row.push(tidy(low * (high / low) ** share));
  }
  const all = field.special === null ? row : [field.special, ...row];
  return all.filter((one, i) => i === 0 || one !== all[i - 1]);
}

function tidy(value) {
  const whole = Math.round(value);
  return whole > 100 ? Number(whole.toPrecision(2)) : whole;
}

export function makeSlider(name, field, onMove) {
  const positions = values(field);
  const box = document.createElement("div");
  box.className = "slider";
  const label = document.createElement("label");
  label.htmlFor = name;
  label.textContent = field.label;
  const range = document.createElement("input");
  Object.assign(range, { type: "range", id: name, min: 0, max: positions.length - 1, step: 1 });
  const exact = document.createElement("input");
  Object.assign(exact, { type: "text", id: `${name}-exact`, inputMode: "decimal", spellcheck: false });
  exact.setAttribute("aria-label", `${field.label}, exact value`);
  box.append(label, range, exact);

  const said = (value) => (value === field.special ? field.special_label : short(value, 12));
  const slider = {
    element: box,
    value: positions[0],
    set(value) {
      slider.value = value;
      let nearest = 0;
      positions.forEach((one, i) => {
        if (Math.abs(one - value) < Math.abs(positions[nearest] - value)) nearest = i;
      });
      range.value = nearest;
      show();
    },
  };
  function show() {
    exact.value = said(slider.value);
    exact.removeAttribute("aria-invalid");
    exact.setCustomValidity("");
    range.setAttribute("aria-valuetext", said(slider.value));
  }
  range.addEventListener("input", () => {
    slider.value = positions[Number(range.value)];
    show();
    onMove(name, slider.value);
  });
  exact.addEventListener("change", () => {
    const text = exact.value.trim().replace(",", ".");
    const value = field.special !== null && text === field.special_label ? field.special : Number(text);
    if (text === "" || !Number.isFinite(value)) {
      exact.setAttribute("aria-invalid", "true");
      exact.setCustomValidity("A number is needed here, such as 0.9.");
      exact.reportValidity();
      return;
    }
    slider.set(value);
    onMove(name, value);
  });
  return slider;
}
