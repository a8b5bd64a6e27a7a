"""What the lab's verdict on a network is worth: predicted at the start, then trained, on random finite problems.

    python scripts/verdict_study.py                                  # 320 problems, eleven minutes of one core
    python scripts/verdict_study.py --problems 20 --updates 500      # a look
    python scripts/verdict_study.py --json --figure docs/images/network-verdict.svg

A problem is a Garnet of 8 states, 2 actions and 2 or 3 successors with normal rewards; half learn the values of a fixed
policy, half those of the greedy one. γ = 1 - 10^u, u in (-2.5, -1); α = 10^u, u in (-1.5, 0.3). How often a state is
updated is random (Dirichlet, concentration 10^u, u in (-2, 0)), in half of them mixed with what the policy visits; so
are the actions. A state is seen as 3 numbers, normal or uniform in (0, 1), times 1 or 3. Networks are fresh: 16 ReLU
units, each of the three layouts. This family was settled on other seeds (10 and above), before those that are reported.

Predicted, by `diagnose_network` with that α: growth of the tangent kernel, ρ(I - αKD(I - γP)), and growth with the
curvature, ρ(I + αG). Trained, from the same weights: the expected update that the verdict speaks of and, as a second
row, the mean of 32 transitions drawn with the same weights; --updates of them. With B = max(r_max / (1 - γ), max |Q| at
the start) the outcome is

    diverges     some |Q| passes 100 B, or is no number
    undecided    not so, but the largest |Q| of the last quarter is more than a tenth above that of the quarter before
    stays        neither

Areas under the ROC curve are of "diverges" against "stays", with 95 % intervals by DeLong et al. (1988), clustered by
problem (Obuchowski 1997). Three more stand beside them: α alone; the kernel's numbers shuffled, which must give 0.5;
and linear features with a fixed policy, whose verdict is exact, which must give 1. It prints, among others:

    linear control                          102        18       200 1.000 (1.00..1.00) ...
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress
from scipy.stats import binomtest
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from neuralq.checks import MissingExtra
from neuralq.lab.figures.drawing import EXACT, Drawing, Panel, Series, svg_of
from neuralq.lab.networks.diagnosis import diagnose_network
from neuralq.lab.networks.expected import expected_backup
from neuralq.lab.networks.representations import PairLinearQ
from neuralq.lab.plain import plain
from neuralq.lab.problems import Problem
from neuralq.mdp import FiniteMDP
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, SeparateQ
from neuralq.types import Array
from neuralq_envs.counterexamples.chains import stationary_distribution

STATES, ACTIONS, SEEN, WEIGHTS = 8, 2, 3, 6
CAP, REST, BATCH = 100.0, 1.1, 32
LAYOUTS: dict[str, Callable[..., nn.Module]] = {
    "action-input": ActionInputQ,
    "separate": SeparateQ,
    "action-output": ActionOutputQ,
}
LOOKS = (0, 100, 1000)  # updates after which the verdict is made
SCORES = ("kernel", "curvature", "step size", "shuffled")
POLICIES = ("fixed", "greedy")
OUTCOMES = ("diverges", "undecided", "stays")
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Case:
    """A problem with what networks see of its states."""

    problem: Problem
    seen: Tensor


def draw(seed: int) -> Case:
    rng = np.random.default_rng([seed, 7])  # not the stream that draws the model
    model = FiniteMDP.garnet(STATES, ACTIONS, int(rng.integers(2, 4)), seed=seed)
    gamma, step_size = 1 - 10 ** rng.uniform(-2.5, -1), 10 ** rng.uniform(-1.5, 0.3)
    normal, scale = rng.random() < 0.5, rng.choice([1.0, 3.0])
    seen = scale * (rng.standard_normal((STATES, SEEN)) if normal else rng.random((STATES, SEEN)))
    target = 0.9 * rng.dirichlet(np.full(ACTIONS, 0.1), size=STATES) + 0.1 / ACTIONS
    apart = 1.0 if rng.random() < 0.5 else rng.random()
    behaviour = apart * rng.dirichlet(np.ones(ACTIONS), size=STATES) + (1 - apart) * target
    elsewhere = np.maximum(rng.dirichlet(np.full(STATES, 10 ** rng.uniform(-2, 0))), 1e-12)
    updated = apart * elsewhere / elsewhere.sum() + (1 - apart) * stationary_distribution(model, target)
    problem = Problem.from_mdp(
        model, rng.standard_normal((STATES, ACTIONS, WEIGHTS)), gamma=gamma, target_policy=target,
        behaviour_policy=behaviour, state_distribution=updated, step_size=step_size,
        initial_weights=rng.standard_normal(WEIGHTS),
    )  # fmt: skip
    return Case(replace(problem, control=bool(rng.random() < 0.5)), torch.tensor(seen))


def linear(case: Case) -> Case:
    """The same model and policies for linear features, with a fixed policy: what is seen of a state are its pairs'."""
    return Case(replace(case.problem, control=False), torch.tensor(case.problem.features))


def starts(layout: str, cases: Sequence[Case], seed: int) -> list[nn.Module]:
    if layout != "linear":
        body, make = MLP(hidden=(16,)), LAYOUTS[layout]
        return [make((SEEN,), ACTIONS, body=body, rng=[seed + i, 11], dtype=torch.float64) for i in range(len(cases))]
    made = [PairLinearQ(WEIGHTS, ACTIONS) for _ in cases]
    for q, case in zip(made, cases, strict=True):
        q.weight.data.copy_(torch.tensor(case.problem.initial_weights))
    return [*made]


@dataclass(frozen=True, eq=False)
class Trained:
    """What came of n runs.

    Args:
        outcome: ``"diverges"``, ``"stays"`` or ``"undecided"``, ``[n]``.
        updates: before |Q| passed the cap, or all of them, ``[n]``.
        weights: by number of updates, those of every run at that time, name by name, ``[n, ...]``.
    """

    outcome: Array
    updates: Array
    weights: dict[int, dict[str, Tensor]]


def train(
    networks: Sequence[nn.Module], cases: Sequence[Case], num_updates: int, rng: np.random.Generator | None = None,
    told: Callable[[], object] = lambda: None,
) -> Trained:  # fmt: skip
    """Every network on its problem, all at once; by sampled transitions if there is a generator to draw them."""
    many = _Many(networks, cases)
    cap = CAP * torch.maximum(many.bound, many.values().detach().abs().amax((1, 2)))
    highest, updates = np.zeros((2, len(cases))), np.full(len(cases), num_updates)
    weights, alive = {}, torch.ones(len(cases), dtype=torch.bool)
    for n in range(num_updates + 1):
        if n in LOOKS:
            weights[n] = {name: x.detach().clone() for name, x in many.parameters.items()}
        q = many.values()
        top = q.detach().abs().amax((1, 2))
        falls = alive & ~(top <= cap)  # also where it is no number
        updates[falls.numpy()] = n
        alive &= ~falls
        quarter = 4 * n // (num_updates + 1) - 2
        if quarter >= 0:
            highest[quarter] = np.fmax(highest[quarter], top.numpy())
        if n < num_updates:
            errors = many.expected(q.detach()) if rng is None else many.sampled(q.detach(), rng)
            many.step(q, torch.where(alive[:, None, None], errors, 0.0))
        if n % 100 == 99:
            told()
    grows = np.where(highest[1] > REST * highest[0], "undecided", "stays")
    return Trained(np.where(alive.numpy(), grows, "diverges"), updates, weights)


class _Many:
    """n networks of one layout with the backups of their problems, as stacked tensors."""

    def __init__(self, networks: Sequence[nn.Module], cases: Sequence[Case]) -> None:
        stacked, self.buffers = stack_module_state([*networks])
        self.parameters = {name: x.detach().clone().requires_grad_() for name, x in stacked.items()}
        backups = [expected_backup(case.problem, case.seen) for case in cases]
        self.seen, self.weights, self.rewards, self.transitions, self.policy = (
            torch.stack([getattr(backup, name) for backup in backups])
            for name in ("observations", "weights", "rewards", "transitions", "target_policy")
        )
        self.gamma, self.greedy, self.step_size = (
            torch.from_numpy(np.array([getattr(case.problem, name) for case in cases]))
            for name in ("gamma", "control", "step_size")
        )
        self.bound = self.rewards.abs().amax((1, 2)) / (1 - self.gamma)
        self.forward = vmap(lambda p, b, s: functional_call(networks[0], (p, b), (s,)))
        self.chances, self.goes = self.weights.flatten(1).cumsum(1), self.transitions.cumsum(-1)

    def values(self) -> Tensor:
        """``[n, S, A]``."""
        found: Tensor = self.forward(self.parameters, self.buffers, self.seen)
        return found

    def state_values(self, q: Tensor) -> Tensor:
        """``[n, S, A] -> [n, S]``."""
        return torch.where(self.greedy[:, None], q.amax(-1), (self.policy * q).sum(-1))

    def expected(self, q: Tensor) -> Tensor:
        """Every cell's expected error by its weight, ``[n, S, A]``."""
        ahead = torch.einsum("nsat,nt->nsa", self.transitions, self.state_values(q))
        return self.weights * (self.rewards + self.gamma[:, None, None] * ahead - q)

    def sampled(self, q: Tensor, rng: np.random.Generator) -> Tensor:
        """Mean error of transitions drawn by the weights, each at its cell, ``[n, S, A]``."""
        runs, (pick, go) = torch.arange(len(q))[:, None], torch.from_numpy(rng.random((2, len(q), BATCH)))
        cells = torch.searchsorted(self.chances, pick * self.chances[:, -1:], right=True)
        s, a = cells // q.shape[-1], cells % q.shape[-1]
        chances = self.goes[runs, s, a]
        s_t = torch.searchsorted(chances, go[..., None] * chances[..., -1:], right=True)[..., 0]
        errors = self.rewards[runs, s, a] + self.gamma[:, None] * self.state_values(q)[runs, s_t] - q[runs, s, a]
        return torch.zeros_like(q).flatten(1).scatter_add(1, cells, errors / BATCH).view_as(q)

    def step(self, q: Tensor, errors: Tensor) -> None:
        """θ += α Σ error ∇Q, in place."""
        found = torch.autograd.grad(q, list(self.parameters.values()), grad_outputs=errors)
        with torch.no_grad():
            for parameter, direction in zip(self.parameters.values(), found, strict=True):
                parameter += self.step_size.reshape(-1, *[1] * (direction.dim() - 1)) * direction


def learn(layout: str, cases: Sequence[Case], seed: int, num_updates: int, told: Callable[[], object]) -> list[Row]:
    """Rows of one layout: what was predicted for each problem, at the start and on the way, and what came of it."""
    networks: list[nn.Module] = starts(layout, cases, seed)
    rows: list[Row] = []
    for kind, rng in (("expected", None), ("sampled", np.random.default_rng([seed, 13]))):
        trained = train(networks, cases, num_updates, rng, told)
        for look, weights in trained.weights.items():
            for i, (q, case) in enumerate(zip(networks, cases, strict=True)):
                if trained.outcome[i] == "diverges" and trained.updates[i] <= look:
                    continue
                q.load_state_dict({name: x[i] for name, x in weights.items()})
                found = diagnose_network(q, case.problem, observations=case.seen)
                grows = "grows at any step" if found.kernel_rate > 0 else "step too large"
                rows.append({
                    "layout": layout, "updates": kind, "look": look, "problem": i, "gamma": case.problem.gamma,
                    "policy": POLICIES[case.problem.control], "step size": found.step_size, "word": found.verdict,
                    "kernel": found.kernel_growth, "curvature": found.growth, "outcome": str(trained.outcome[i]),
                    "reason": grows if found.kernel_growth > 1 else "shrinks", "fell after": int(trained.updates[i]),
                })  # fmt: skip
        networks = starts(layout, cases, seed)
    shuffled = np.random.default_rng([seed, 17]).permutation([row["kernel"] for row in rows])
    return [{**row, "shuffled": float(x)} for row, x in zip(rows, shuffled, strict=True)]


def roc(scores: Array, positive: Array, cluster: Array) -> tuple[float, float, float]:
    """Area under the ROC curve with its 95 % interval: DeLong et al. 1988, clusters as in Obuchowski 1997.

    Args:
        scores: higher for what should be positive, ``[n]``.
        positive: ``[n]``, bool; where a side has fewer than two clusters nothing is known.
        cluster: which of them belong together, ``[n]``.
    """
    if min(len(np.unique(cluster[positive])), len(np.unique(cluster[~positive]))) < 2:
        return float("nan"), 0.0, 1.0
    beats = scores[positive][:, None] - scores[~positive]
    wins = (beats > 0) + 0.5 * (beats == 0)
    area = float(wins.mean())
    sides = []
    for side, placement in ((positive, wins.mean(1)), (~positive, wins.mean(0))):
        excess = np.zeros(len(scores))
        excess[side] = placement - area
        sides.append((np.bincount(cluster, excess, cluster.max() + 1) / side.sum(), len(np.unique(cluster[side]))))
    (here, num_here), (there, num_there) = sides
    num = len(np.unique(cluster))
    variance = (
        num_here / (num_here - 1) * (here**2).sum() + num_there / (num_there - 1) * (there**2).sum()
        + 2 * num / (num - 1) * (here * there).sum()
    )  # fmt: skip
    half = 1.96 * float(np.sqrt(max(variance, 0.0)))  # rounding may leave less than 0
    return area, max(area - half, 0.0), min(area + half, 1.0)


def share(hits: int, num: int) -> tuple[float, float, float]:
    """Of ``num`` that are at least 1, with its 95 % interval (Wilson 1927)."""
    interval = binomtest(hits, num).proportion_ci(method="wilson")
    return hits / num, float(interval.low), float(interval.high)


def areas(rows: Sequence[Row], undecided: str | None = None) -> dict[str, Any]:
    """How many did what, and the area of each score; undecided ones are left out, or count as what is named."""
    outcomes = [undecided or x if (x := row["outcome"]) == "undecided" else x for row in rows]
    kept = np.array([x != "undecided" for x in outcomes])
    fell, cluster = np.array(outcomes)[kept] == "diverges", np.array([row["problem"] for row in rows])[kept]
    scores = {name: roc(np.array([row[name] for row in rows])[kept], fell, cluster) for name in SCORES}
    return {**{name: sum(row["outcome"] == name for row in rows) for name in OUTCOMES}, **scores}


def deciles(rows: Sequence[Row], score: str, num: int = 10) -> list[Row]:
    """By tenths of the score: from where to where, how many, and the share that diverged within the horizon."""
    ordered = sorted(rows, key=lambda row: float(row[score]))
    parts = [[ordered[i] for i in part] for part in np.array_split(np.arange(len(ordered)), num) if len(part)]
    fell = [share(sum(row["outcome"] == "diverges" for row in part), len(part)) for part in parts]
    edges = [(part[0][score], part[-1][score], len(part)) for part in parts]
    return [{"from": a, "to": b, "runs": n, "diverged": x} for (a, b, n), x in zip(edges, fell, strict=True)]


def shares(rows: Sequence[Row], name: str) -> dict[str, Any]:
    """By the word or the reason: outcomes, and the share that diverged."""
    found = {}
    for said in sorted({row[name] for row in rows}):
        mine = [row["outcome"] for row in rows if row[name] == said]
        counts = {outcome: mine.count(outcome) for outcome in OUTCOMES}
        found[said] = {**counts, "diverged": share(counts["diverges"], len(mine))}
    return found


def missed(rows: Sequence[Row]) -> dict[str, Any]:
    """Runs that the kernel at the start was wrong about, and what it said of them later."""
    first = [row for row in rows if row["look"] == 0]
    fell = [row for row in first if row["kernel"] <= 1 and row["outcome"] == "diverges"]
    stayed = [row for row in first if row["kernel"] > 1 and row["outcome"] == "stays"]
    later = {(row["layout"], row["problem"], row["look"]): row["kernel"] > 1 for row in rows}

    def looks(of: Sequence[Row]) -> dict[int, list[int]]:
        """At each later look: how many had not fallen yet, and on how many the kernel then said that it grows."""
        said = {n: [later.get((row["layout"], row["problem"], n)) for row in of] for n in LOOKS[1:]}
        return {n: [sum(x is not None for x in found), sum(x is True for x in found)] for n, found in said.items()}

    quartiles = np.percentile([row["fell after"] for row in fell] or [0], (25, 50, 75)).tolist()
    return {
        "shrinks, diverged": len(fell), "greedy of these": sum(row["policy"] == "greedy" for row in fell),
        "fell after, quartiles": quartiles, "left and named at looks": looks(fell),
        "grows, stayed": len(stayed), "at any step of those": sum(row["reason"] != "step too large" for row in stayed),
        "left and named of those": looks(stayed),
    }  # fmt: skip


def some(of: Sequence[Row], **wanted: Any) -> list[Row]:
    """Rows with these entries."""
    return [row for row in of if all(row[name] == x for name, x in wanted.items())]


def summary(all_rows: Sequence[Row]) -> dict[str, Any]:
    """Everything that is printed, from the rows alone."""
    rows, groups = [row for row in all_rows if row["layout"] != "linear"], dict[str, list[Row]]()
    for kind in ("expected", "sampled"):
        start = some(rows, updates=kind, look=0)
        groups |= {f"{kind}, {layout}, {policy}": some(start, layout=layout, policy=policy)
                   for policy in POLICIES for layout in LAYOUTS}  # fmt: skip
        groups |= {f"{kind}, all, {policy}": some(start, policy=policy) for policy in POLICIES}
        groups |= {f"{kind}, {layout}": some(start, layout=layout) for layout in LAYOUTS} | {f"{kind}, all": start}
    expected, start = some(rows, updates="expected"), some(rows, updates="expected", look=0)
    groups |= {f"after {look:,} updates, all": some(expected, look=look) for look in LOOKS[1:]}
    groups["linear control"] = some(all_rows, layout="linear", updates="expected", look=0)
    tables = {name: areas(group) for name, group in groups.items() if group}
    tables |= {f"expected, undecided counted {x}": areas(start, x) for x in ("diverges", "stays")}
    return {
        "areas": tables,
        "deciles": {score: deciles(start, score) for score in SCORES[:2]},
        "words": {"verdict": shares(start, "word")} | {f"{x} policy, kernel": shares(some(start, policy=x), "reason")
                                                       for x in POLICIES},
        "missed": missed(expected),
    }  # fmt: skip


def told(found: dict[str, Any]) -> str:
    """The tables in text."""
    lines = [_line("updates, layout, policy", OUTCOMES, [f"{score} AUC" for score in SCORES])]
    for name, row in found["areas"].items():
        lines.append(_line(name, [row[x] for x in OUTCOMES], [_interval(row[x]) for x in SCORES]))
    for score, rows in found["deciles"].items():
        lines += ["", _line(f"{score} growth, tenths", ("runs",), ("diverged",))]
        for row in rows:
            between = f"{row['from']:.6g} .. {row['to']:.6g}"
            lines.append(_line(between, (row["runs"],), (_interval(row["diverged"]),)))
    for name, table in found["words"].items():
        lines += ["", _line(name, OUTCOMES, ("diverged",))]
        lines += [_line(word, [x[y] for y in OUTCOMES], [_interval(x["diverged"])]) for word, x in table.items()]
    return "\n".join([*lines, "", *(f"{name}: {x}" for name, x in found["missed"].items())])


def _line(name: str, counts: Sequence[object], shares: Sequence[str]) -> str:
    return f"{name:<36}" + "".join(f"{x:>10}" for x in counts) + "".join(f"{x:>19}" for x in shares)


def _interval(x: Sequence[float]) -> str:
    return f"{x[0]:.3f} ({x[1]:.2f}..{x[2]:.2f})"


def picture(rows: Sequence[Row], caption: str) -> Drawing:
    """ROC curves, and the share that diverged by tenths of the predicted growth."""
    start = some(rows, updates="expected", look=0)
    exact = _curve(some(start, layout="linear"), "kernel")
    curves, points = [Series("linear features (control)", *exact, "dashed", EXACT)], []
    for colour, policy in enumerate(POLICIES):
        mine = [row for row in some(start, policy=policy) if row["layout"] != "linear"]
        curves.append(Series(f"{policy} policy, tangent kernel", *_curve(mine, "kernel"), "line", colour))
        curves.append(Series(f"{policy} policy, with curvature", *_curve(mine, "curvature"), "dotted", colour))
        middle, low, high = np.reshape([row["diverged"] for row in deciles(mine, "kernel")], (-1, 3)).astype(float).T
        points.append(Series(f"{policy} policy", np.arange(1.0, len(low) + 1), middle, "line", colour, low, high))
    curves.append(Series("chance", np.array([0.0, 1]), np.array([0.0, 1]), "dotted", EXACT))
    return Drawing(
        "network-verdict", "Fresh networks: a verdict helps with a fixed policy, hardly in control", "ours", caption,
        (
            Panel("Told apart before training", "share of those that stay, named", "share of those that diverge, named",
                  tuple(curves), y_limits=(0, 1.02), legend="lower right"),
            Panel("What came of it", "tenth by predicted growth (tangent kernel)", "share that diverged", tuple(points),
                  y_limits=(0, 1.02), legend="upper left"),
        ),
        height=3.8,
    )  # fmt: skip


def _curve(rows: Sequence[Row], score: str) -> tuple[Array, Array]:
    kept = sorted((row for row in rows if row["outcome"] != "undecided"), key=lambda row: -float(row[score]))
    fell = np.array([row["outcome"] == "diverges" for row in kept])
    return np.r_[0, np.cumsum(~fell)] / max((~fell).sum(), 1), np.r_[0, np.cumsum(fell)] / max(fell.sum(), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=_count, default=320, help="random problems (default 320)")
    parser.add_argument("--updates", type=_count, default=10_000, help="of each run (default 10,000)")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random (default 0)")
    parser.add_argument("--figure", type=_file, metavar="PATH", help="where to draw, for example verdict.svg")
    parser.add_argument("--out", type=_file, metavar="PATH", help="every run with its predictions, as JSON")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    torch.set_num_threads(1)
    began, seed = time.perf_counter(), 1_000_000 * options.seed
    cases = [draw(seed + i) for i in range(options.problems)]
    rows: list[Row] = []
    with Progress() as progress:
        bar = progress.add_task("training", total=2 * (len(LAYOUTS) + 1) * (options.updates // 100))
        for layout in (*LAYOUTS, "linear"):
            of = [linear(case) for case in cases] if layout == "linear" else cases
            rows += learn(layout, of, seed, options.updates, lambda: progress.advance(bar))
    found = summary(rows)
    print(told(found))
    print(
        f"{len(cases)} problems, {options.updates:,} updates, seed {options.seed}, {time.perf_counter() - began:.0f} s"
    )
    if options.out is not None:
        options.out.write_text(json.dumps(rows), encoding="utf-8")
    if options.figure is not None:
        caption = (
            f"{len(cases)} random problems, three layouts, seed {options.seed}, {options.updates:,} expected updates. "
            "Dashed: linear features, where the verdict is exact. Bands: 95 % intervals (Wilson)."
        )
        try:
            options.figure.write_text(svg_of(picture(rows, caption)) + "\n", encoding="utf-8")
        except MissingExtra as error:
            raise SystemExit(str(error)) from error
        print(f"wrote {options.figure}")
    if options.json:
        print(json.dumps(plain(found)))


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a whole number of at least 1, got {text!r}")
    return int(text)


def _file(text: str) -> Path:
    if not Path(text).parent.is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {str(Path(text).parent)!r}; make it first")
    return Path(text)


if __name__ == "__main__":
    main()
