"""How far the doctor can be trusted: every planted disease and healthy runs, and what it named first.

    python scripts/doctor_study.py --out doctor_study
    python scripts/doctor_study.py --only 1 7 healthy --seeds 1 --out doctor_study
    python scripts/doctor_study.py --out doctor_study --decide-again

Subjects are those of doctor_subjects.py: diseases by number, 0 for none, and healthy runs. Every row goes to rows.jsonl
in the folder as soon as it is known: what was measured, whole, and what was named. Rows that are there are not run
again, so that it may be stopped at any time; --decide-again puts what was measured through the present decision tree
without training or measuring anything. At the end: the confusion matrix, every miss, times, and for each threshold that
is our own the range that seeds 0 to 4 allow and what it does on the others, which nothing was set by.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from doctor_subjects import DISEASES, HEALTHY, Control, ill, well

from neuralq.doctor import examine
from neuralq.doctor.findings import Finding
from neuralq.doctor.report import Report
from neuralq.doctor.tree import decide

SET_BY = 5
"""Thresholds and rules were set by as many seeds, and are judged by those that follow."""


def diagnose(number: str, seed: int, budget_s: float) -> dict[str, Any]:
    """Train one subject with a disease and say what the doctor named."""
    disease, began = DISEASES[number], time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        subject, rows = ill(number, seed, Path(folder))
        trained = time.process_time() - began
        data = rows if disease.gives_data else None
        report = examine(subject, disease.make, gamma=disease.gamma, data=data, budget_s=budget_s, seed=seed)
    trainer = "plain" if disease.plan is not None else "Stable-Baselines3"
    return {"disease": number, "name": disease.name, "seed": seed, "trainer": trainer, **_found(report, trained)}


def healthy(control: Control, seed: int, budget_s: float) -> dict[str, Any]:
    """Train one healthy agent and say whether the doctor finds anything."""
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = well(control, seed, Path(folder))
        trained = time.process_time() - began
        report = examine(path, None if control.trainer == "neuralq" else control.make, budget_s=budget_s, seed=seed)
    row = {"disease": "healthy", "name": f"{control.env}, {control.trainer}", "seed": seed, "trainer": control.trainer}
    return {**row, **_found(report, trained), "at_least": control.at_least}


def _found(report: Report, trained: float) -> dict[str, Any]:
    return {
        **_named(report.findings, report.cause), "measured": [one.plain() for one in report.measured],
        "not_measured": dict(report.not_measured), "train_cpu_s": round(trained, 1), "exam_s": round(report.seconds, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }  # fmt: skip


def _named(findings: Sequence[Finding], cause: str | None) -> dict[str, Any]:
    return {"cause": cause, "named": [one.id for one in findings if one.grade in "AB"]}


def decided_again(row: Mapping[str, Any]) -> dict[str, Any]:
    """The row as the present decision tree would have it."""
    found = [
        Finding(**{
            **one, "value": float("nan") if one["value"] is None else one["value"],
            "interval": one["interval"] and tuple(float("nan") if b is None else b for b in one["interval"]),
        })
        for one in row["measured"]
    ]  # fmt: skip
    findings, headline = decide(found)
    report = Report("", "", 0.0, headline, findings, tuple(found), {}, 0.0)
    return {**row, **_named(findings, report.cause)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[*DISEASES, "healthy"], help="diseases by number, or healthy")
    parser.add_argument("--seeds", type=int, default=10, help="of each disease; healthy runs have 3 of 5")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of each examination")
    parser.add_argument("--out", type=Path, default=Path("doctor_study"), help="folder of rows.jsonl")
    parser.add_argument("--decide-again", action="store_true", help="only decide again from what was measured")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "rows.jsonl"
    rows = [json.loads(line) for line in file.read_text("utf-8").splitlines()] if file.exists() else []
    if options.decide_again:
        rows = [decided_again(row) for row in rows]
    else:
        _run(options.only, options.seeds, options.budget, rows, file)
    print(summary(rows))


def _run(only: Sequence[str], seeds: int, budget_s: float, rows: list[dict[str, Any]], file: Path) -> None:
    """What is missing among the rows, seed by seed, so that what comes first says something of everything."""
    known = {(row["disease"], row["name"], row["seed"]) for row in rows}
    for seed in range(seeds):
        wanted: list[tuple[tuple[str, str, int], Callable[[], dict[str, Any]]]] = [
            ((number, DISEASES[number].name, seed), partial(diagnose, number, seed, budget_s))
            for number in only if number != "healthy"
        ]  # fmt: skip
        if "healthy" in only and seed % SET_BY < 3:
            wanted += [
                (("healthy", f"{one.env}, {one.trainer}", seed), partial(healthy, one, seed, budget_s))
                for one in HEALTHY
            ]
        for key, make in wanted:
            if key not in known:
                row = json.loads(json.dumps(make(), default=float))
                rows.append(row)
                with file.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(row) + "\n")
                print(_line(row), flush=True)


def _value(row: Mapping[str, Any], name: str) -> dict[str, Any] | None:
    return next((one for one in row["measured"] if one["id"] == name), None)


def _is_healthy(row: Mapping[str, Any]) -> bool:
    """Whether a row without a planted disease is one by its return, of which the doctor knows nothing."""
    learned = _value(row, "V1")
    at_least = row.get("at_least", 95.0)
    return row["disease"] in ("healthy", "0", "0p") and learned is not None and learned["value"] >= at_least


def _is_right(row: Mapping[str, Any]) -> bool:
    if row["disease"] in ("healthy", "0", "0p"):
        return not row["named"]
    return row["cause"] in DISEASES[row["disease"]].causes


def _line(row: Mapping[str, Any]) -> str:
    learned = _value(row, "V1")
    score = "?" if learned is None or learned["value"] is None else f"{learned['value']:.4g}"
    verdict, named = "right " if _is_right(row) else "MISSED", " ".join(row["named"]) or "nothing"
    return (
        f"{row['disease']:>8} {row['name']:<46} seed {row['seed']} {verdict} {row['cause']}: {named}; return {score}, "
        f"trained in {row['train_cpu_s']} CPU-s, examined in {row['exam_s']} s"
    )


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """The confusion matrix of either half of the seeds, the misses, thresholds, and times."""
    unfit = [row for row in rows if row["disease"] in ("healthy", "0", "0p") and not _is_healthy(row)]
    kept = [row for row in rows if row not in unfit]
    missed = [row for row in kept if not _is_right(row)]
    seconds, peak = [row["exam_s"] for row in rows], max(row["peak_mb"] for row in rows)
    took = f"{statistics.median(seconds)} s in the median and {max(seconds)} s at most"
    return "\n".join([
        f"Seeds from {SET_BY} on, which nothing was set by", _table([row for row in kept if row["seed"] >= SET_BY]), "",
        f"Seeds below {SET_BY}", _table([row for row in kept if row["seed"] < SET_BY]), "", "Missed",
        *map(_line, missed), "",
        "Left out: nothing was planted, and the return is below what is called healthy", *map(_line, unfit), "",
        "Thresholds of our own", _thresholds(kept), "",
        f"Examinations took {took}; the process, with training, {peak} MB at most",
    ])  # fmt: skip


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The confusion matrix: per disease, how often each cause came first."""
    causes = ["environment", "algorithm", "representation", "data", "luck", None]
    head = "| planted | " + " | ".join(str(c or "none") for c in causes) + " | first finding | right |"
    lines = [head, "|---" * 9 + "|"]
    for name in dict.fromkeys(row["name"] for row in rows):
        mine = [row for row in rows if row["name"] == name]
        counts = [str(sum(row["cause"] == cause for row in mine) or "") for cause in causes]
        firsts = Counter(row["named"][0] if row["named"] else "none" for row in mine)
        first = ", ".join(f"{k} × {n}" for k, n in firsts.most_common())
        lines.append(f"| {name} | {' | '.join(counts)} | {first} | {sum(map(_is_right, mine))} of {len(mine)} |")
    return "\n".join(lines)


Statistic = Callable[[dict[str, Any]], float]
OWN: dict[str, tuple[float, bool, Statistic]] = {
    "E3": (0.0, False, lambda one: one["value"] - one["threshold"]),
    "E4": (100.0, True, lambda one: one["value"]),
    "E5": (1e4, True, lambda one: one["value"]),
    "E6": (0.10, True, lambda one: one["interval"][0]),
    "V2": (0.10, True, lambda one: max(one["interval"][0], -one["interval"][1])),
    "V3": (0.80, False, lambda one: one["value"]),
    "V5": (0.90, False, lambda one: one["value"]),
    "V7a": (1.0, True, lambda one: one["value"]),
    "R1": (0.5, True, lambda one: one["interval"][0]),
    "R6a": (1.5, False, lambda one: 1.5 * one["value"] / one["threshold"]),
    "R7": (0.10, True, lambda one: one["interval"][0]),
    "D3": (3.0, False, lambda one: one["value"]),
    "D3a": (10.0, False, lambda one: one["value"]),
}
"""Thresholds of our own: as they are in the doctor, whether more is worse, and what is held against them."""


def _thresholds(rows: Sequence[Mapping[str, Any]]) -> str:
    """Per threshold: what the first seeds allow, and how the others fare with the one that the doctor has."""
    head = (
        f"| id | in use | healthy, below {SET_BY} | diseased, below {SET_BY} | the others: found | healthy, flagged |"
    )
    lines = [head, "|---" * 6 + "|"]
    for name, (threshold, more, statistic) in OWN.items():
        found: dict[tuple[bool, bool], list[float]] = {
            (ill, late): [] for ill in (True, False) for late in (False, True)
        }
        for row in rows:
            disease, one = DISEASES.get(row["disease"]), _value(row, name)
            is_ill = disease is not None and name in disease.ids.split()
            if one is not None and one["value"] is not None and (is_ill or _is_healthy(row)):
                found[is_ill, row["seed"] >= SET_BY].append(statistic(one))
        worst = (max if more else min)(found[False, False], default=float("nan"))
        mildest = (min if more else max)(found[True, False], default=float("nan"))
        beyond = [[(v > threshold) == more for v in found[ill, True]] for ill in (True, False)]
        shares = " | ".join(f"{sum(b)} of {len(b)}" for b in beyond)
        signs = ("≤", "≥") if more else ("≥", "≤")
        lines.append(f"| {name} | {threshold:g} | {signs[0]} {worst:.3g} | {signs[1]} {mildest:.3g} | {shares} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
