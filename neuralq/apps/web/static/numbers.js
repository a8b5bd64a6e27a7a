// The table of what was found.

import { bound, factor, short } from "./words.js";

export function showNumbers(table, found) {
  const rows = [
    ["growth of the mean, ρ", factor(found.spectral_radius)],
    ["growth of the second moment", found.second_moment_radius === null ? null : factor(found.second_moment_radius)],
    ["the mean converges for", found.step_size_bound.value === null && !found.step_size_bound.every ? null : bound(found.step_size_bound)],
    ["the variance settles for", found.step_size_bound_second_moment.value === null && !found.step_size_bound_second_moment.every ? null : bound(found.step_size_bound_second_moment)],
    ["the error doubles every", found.doubling_time === null ? null : `${short(found.doubling_time)} updates`],
    ["the leading mode", found.oscillates ? "oscillates" : "does not oscillate"],
    ["error of the fixed point (RMS)", found.fixed_point_error === null ? null : short(found.fixed_point_error)],
    ["least error of any weights", found.best_error === null ? null : short(found.best_error)],
    ["dimension of what moves", String(found.rank)],
  ];
  table.replaceChildren(...rows.filter((row) => row[1] !== null).map(([name, value]) => {
    const row = document.createElement("tr");
    const head = document.createElement("th");
    head.scope = "row";
    head.textContent = name;
    const cell = document.createElement("td");
    cell.textContent = value;
    row.append(head, cell);
    return row;
  }));
}
