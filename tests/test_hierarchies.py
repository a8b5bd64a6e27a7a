"""CQ-L against its formulas in NumPy, options on a line, the room of landmarks against its map, and its page.

Mutants that die here: a share that is not weighed by the gate, by the squared error or by both; errors without K, of
the first steps, or from one step too late; K that moves by the step of the modules; modules that learn from the first
step to the last, from K as if it were theirs, or all alike; a failed stage that teaches values; logits without a
bound; an option that does not act, is asked before it has moved, forgets γ or counts one step less; a landmark out of
turn that counts, a stage that begins again at the start, a start on the first landmark; a ratio of the elemental
tasks.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Discrete

from neuralq.systems import run_system, system_named
from neuralq.systems.hierarchies import oracle, studies, system
from neuralq.tabular import (
    CompositionalRates,
    compositional_action,
    compositional_module,
    compositional_update,
    compositional_value,
    new_compositional_q,
    new_stream,
    run_option,
)
from neuralq_envs.landmarks import LAYOUT, TASKS, room


def softmax(x: Any) -> Any:
    return np.exp(x - np.max(x)) / np.exp(x - np.max(x)).sum()


def drawn(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    learned = new_compositional_q(3, 7, 4, 5)
    learned.q[:], learned.gates[:], learned.biases[:] = (
        rng.normal(size=learned.q.shape), rng.uniform(-3.5, 3.5, learned.gates.shape), rng.normal(size=5)
    )  # fmt: skip
    return learned, rng


@pytest.mark.parametrize(("num_steps", "num_judged"), [(1, 20), (9, 4), (9, 9), (6, 20)])
def test_a_stage_teaches_what_the_formulas_say(num_steps: int, num_judged: int) -> None:
    rates = CompositionalRates(0.4, sigma=0.6, gate_step=0.8, bias_step=0.3, num_judged=num_judged)
    for seed in range(5):
        learned, rng = drawn(seed)
        stage, following = int(rng.integers(5)), float(rng.normal())
        s, a, r = rng.integers(0, 7, 12), rng.integers(0, 4, 12), rng.normal(size=12)
        q, gates, biases = learned.q.copy(), learned.gates.copy(), learned.biases.copy()
        compositional_update(learned, rates, stage, 1, s, a, r, num_steps, following, True, seed == 4)
        rows = range(max(num_steps - num_judged, 0), num_steps)
        errors = [[r[i:num_steps].sum() + following - biases[stage] - q[m, s[i], a[i]] for i in rows] for m in range(3)]
        g = softmax(gates[stage])
        h = g * np.exp(-np.mean(np.square(errors), axis=1) / (2 * 0.6**2))
        h /= h.sum()
        gates[stage] = np.clip(gates[stage] + 0.8 * (h - g), -4, 4)
        for m in range(3):
            for i in reversed(range(num_steps)):
                best = q[m, s[i + 1]].max() if i < num_steps - 1 else following - biases[stage]
                q[m, s[i], a[i]] += 0.4 * h[m] * (r[i] + best - q[m, s[i], a[i]])
        biases[stage] += 0.3 * h @ np.mean(errors, axis=1) * (seed != 4)
        assert np.allclose(learned.q, q) and np.allclose(learned.gates, gates) and np.allclose(learned.biases, biases)


def test_a_stage_that_was_not_reached_says_only_that_its_module_was_not_the_one() -> None:
    learned, _ = drawn(3)
    q, gates, biases = learned.q.copy(), learned.gates.copy(), learned.biases.copy()
    path = np.zeros(2, int), np.zeros(2, int), np.ones(2)
    compositional_update(learned, CompositionalRates(), 2, 1, *path, 2, 5.0, False, False)
    g = softmax(gates[2])
    h = g * [1.0, 0.02, 1.0]
    gates[2] += h / h.sum() - g
    assert np.allclose(learned.gates, gates) and np.array_equal(learned.q, q) and np.array_equal(learned.biases, biases)
    compositional_update(learned, CompositionalRates(gate_step=1e4), 2, 1, *path, 2, 5.0, False, False)
    assert learned.gates[2, 1] == -4.0 and np.abs(learned.gates).max() == 4.0


def test_modules_and_actions_are_drawn_as_often_as_they_should_be() -> None:
    learned, _ = drawn(1)
    stream, rates = new_stream(0), CompositionalRates(epsilon=0.2, temperature=0.7)
    modules = np.bincount([compositional_module(learned, 4, stream) for _ in range(4000)], minlength=3) / 4000
    assert np.abs(modules - softmax(learned.gates[4])).max() < 0.03
    taken = np.bincount([compositional_action(learned, rates, 2, 5, stream) for _ in range(4000)], minlength=4) / 4000
    assert np.abs(taken - (0.05 + 0.8 * softmax(learned.q[2, 5] / 0.7))).max() < 0.03
    value = learned.biases[4] + softmax(learned.gates[4]) @ learned.q[:, 5].max(axis=1)
    assert compositional_value(learned, 4, 5) == pytest.approx(value)


class Line(gymnasium.Env[Any, Any]):
    """Whole numbers, each step one up; it pays the number that was left, ends at 9 and breaks off at 7."""

    observation_space, action_space = Discrete(10), Discrete(2)

    def __init__(self, breaks_off: bool = False) -> None:
        self.at, self.breaks_off = 0, breaks_off

    def step(self, action: int) -> Any:
        assert action == 1
        self.at += 1
        return self.at, self.at - 1.0, self.at == 9, self.breaks_off and self.at == 7, {}


def test_an_option_runs_until_its_end() -> None:
    asked: list[int] = []

    def act(s: int) -> int:
        asked.append(s)
        return 1

    assert run_option(Line(), 0, act, lambda s: s == 4, gamma=0.5) == (
        1 * 0.5 + 2 * 0.25 + 3 * 0.125, 4, 4, False, False
    )  # fmt: skip
    assert asked == [0, 1, 2, 3]
    assert run_option(Line(), 0, act, lambda s: s == 0)[1:] == (9, 9, True, False)
    assert run_option(Line(True), 0, act, lambda s: False)[1:] == (7, 7, False, True)
    assert run_option(Line(), 0, act, lambda s: False, most_steps=3)[1:] == (3, 3, False, False)
    assert run_option(Line(), 0, act, lambda s: True)[:2] == (0.0, 1)  # it acts once in any case


@pytest.mark.parametrize("num_steps", [500, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_room_is_walked_as_on_its_map(num_steps: int) -> None:
    env, rows = gymnasium.make("neuralq/Landmarks-v0"), LAYOUT.split()
    stages = [(task, i) for task in TASKS for i in range(len(task))]
    rng, ends, seen = np.random.default_rng(0), 0, set()
    s, _ = env.reset(seed=0)
    for a in rng.integers(0, 4, num_steps).tolist():
        (task, i), (row, column) = stages[s // 64], divmod(s % 64, 8)
        ahead = (row + (-1, 0, 1, 0)[a], column + (0, 1, 0, -1)[a])
        if 0 <= min(ahead) and max(ahead) < 8 and rows[ahead[0]][ahead[1]] != "#":
            row, column = ahead
        reached = rows[row][column] == task[i]
        s, reward, terminated, _, _ = env.step(a)
        assert divmod(s % 64, 8) == (row, column) and terminated == (reached and i == len(task) - 1)
        assert reward == pytest.approx(-0.05 + terminated)
        assert stages[s // 64] == (task, i + (reached and not terminated))
        if terminated:
            s, _ = env.reset()
            ends, seen = ends + 1, seen | {stages[s // 64]}
            assert stages[s // 64][1] == 0 and rows[s % 64 // 8][s % 8] not in ("#", stages[s // 64][0][0])
    assert ends and (num_steps < 1000 or {task for task, _ in seen} == set(TASKS))


def test_the_room_can_be_looked_at() -> None:
    env = gymnasium.make("neuralq/Landmarks-v0", render_mode="ansi", tasks=("AC",))
    env.reset(options={"state": 8})
    env.step(1)
    lines = env.render().splitlines()
    assert lines[1] == ". @ . . . . . ." and lines[3] == ". . # # # # . ." and lines[-1] == "A[C]"
    picture = gymnasium.make("neuralq/Landmarks-v0", render_mode="rgb_array")
    picture.reset(options={"state": 64 + 7})
    pixels = picture.render()
    row, column = np.argwhere((pixels == (40, 90, 190)).all(axis=2)).mean(axis=0)
    assert abs(row - 0.5 * 48) < 1 and abs(column - 7.5 * 48) < 1
    assert (pixels[8 * 48 + 5, 5] == (170, 215, 170)).all() and (pixels[8 * 48 + 5, 48 + 5] == 255).all()  # task B


def test_steps_of_a_policy_are_those_of_its_episodes() -> None:
    assert studies.SHORTEST.round(3).tolist() == [5.661, 5.119, 5.593, 10.661, 11.119, 20.661]
    rng = np.random.default_rng(0)
    policy = studies._shortest_policy()
    policy[rng.random(policy.shape) < 0.03] = 0
    means, model = studies.mean_steps(policy, 50), gymnasium.make("neuralq/Landmarks-v0").unwrapped
    for task, first in enumerate(studies.ROOM.first[:-1].tolist()):
        counts = []
        for cell in studies.ROOM.free.tolist():
            if cell == studies.ROOM.goals[first]:
                continue
            s, steps, terminated = model.reset(options={"state": first * 64 + cell})[0], 0, False
            while steps < 50 and not terminated:
                s, _, terminated, _, _ = model.step(int(policy[s // 64, s % 64]))
                steps += 1
            counts.append(steps)
        assert means[task] == pytest.approx(np.mean(counts))


def test_the_constant_is_what_the_rest_costs() -> None:
    values, spreads = oracle.constants(-0.1)
    assert np.allclose(values, [0, 0, 0, -0.5, 0, -0.6, 0, -1.5, -0.6, 0]) and spreads.max() < 1e-9


def test_studies_learn_what_they_say() -> None:
    seed = np.random.SeedSequence(3)
    modules, again = (studies.modules_study(np.random.SeedSequence(3), num_trials=40) for _ in range(2))
    assert np.array_equal(modules.ratios, again.ratios) and modules.trials.tolist() == [0, 20, 40]
    assert modules.gates[:3].argmax(axis=1).tolist() == [0, 1, 2] and modules.values.max() <= 0.95 + 1e-9
    unbiased = studies.modules_study(seed, CompositionalRates(bias_step=0.0), num_trials=40)
    assert not unbiased.biases.any() and modules.biases[3] < 0
    skills = studies.skills_study(np.random.SeedSequence(5), num_trials=200)
    assert skills.ratios[0] > 1.25 >= skills.ratios[-1]
    chosen = skills.gates[3:].argmax(axis=1)
    assert np.array_equal(chosen, studies.ROOM.landmarks[3:])
    flat = studies.flat_study(np.random.SeedSequence(6), 60)
    assert flat.trials[0] == 0 and flat.trials[-1] >= 60 and (np.diff(flat.trials) > 0).all() and flat.ratios[0] > 5


def made(enough: float, chosen: Any = None) -> Any:
    gates = np.eye(3)[studies.ROOM.landmarks if chosen is None else chosen]
    trials, ratios = np.array([0.0, enough, 2000.0]), np.array([9.0, 1.25, 1.3])
    return (studies.Study(trials, ratios, gates, np.zeros(10), np.zeros((3, 64))),)


def test_the_page_says_what_came_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("modules_picture", "curve_picture"):
        monkeypatch.setattr(system, picture, lambda *_: None)
    found = {
        system.SKILLS: made(100), system.MODULES: made(500), system.UNBIASED: made(1500),
        system.UNLABELLED: made(40, (studies.ROOM.landmarks + 1) % 3), system.FLAT: made(1000),
    }  # fmt: skip
    page = system.HIERARCHIES.page(found, False)
    assert page.reproduced and page.text[0].startswith("Reproduced") and "in 1 of 1 seeds" in page.text[2]
    assert page.measured[0].values == (100.0,)
    for i, (name, bad) in enumerate(
        ((system.SKILLS, 101), (system.MODULES, 501), (system.FLAT, 999), (system.UNBIASED, 1499))
    ):
        page = system.HIERARCHIES.page({**found, name: made(bad)}, False)
        assert page.rows[i].verdict == "not reproduced" and page.text[0].startswith("Not reproduced")
    wrong = studies.ROOM.landmarks.copy()
    wrong[8] = 2
    for chosen in (wrong, [0, 0, 2, 0, 2, 0, 2, 0, 0, 2]):  # another module, and one module for two landmarks
        page = system.HIERARCHIES.page({**found, system.UNLABELLED: made(40, chosen)}, False)
        assert "in 0 of 1 seeds" in page.text[2]
    never = dataclasses.replace(made(5)[0], ratios=np.array([9.0, 2.0, 1.3]))
    assert str(system.trials_to_enough((never,), "x")) == "over 2,000"


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: room([]), "a list of sequences of landmarks"),
        (lambda: room("ABC"), "a list of sequences of landmarks"),
        (lambda: room(["AD"]), "none twice in a row, got 'AD'"),
        (lambda: room(["ABB"]), "none twice in a row, got 'ABB'"),
        (lambda: gymnasium.make("neuralq/Landmarks-v0", step_reward=np.nan), "step_reward must be finite"),
        (lambda: new_compositional_q(0, 4, 4, 1), "num_modules must be a whole number of at least 1"),
        (lambda: run_option(Line(), 0, lambda s: 1, lambda s: True, gamma=1.5), "gamma must"),
        (lambda: run_option(Line(), 0, lambda s: 1, lambda s: True, most_steps=0), "most_steps must be"),
        (lambda: studies.skills_study(np.random.SeedSequence(0), 0), "num_trials must be"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        act()


@pytest.mark.slow
def test_what_is_known_of_elemental_tasks_makes_composite_ones_easy() -> None:
    found = run_system(system_named("hierarchies"))
    trials = {one.what.partition(":")[0]: one for one in found.measured[:5]}
    assert len(found.measured[0].values) == 20 and found.reproduced and not found.wrong
    assert trials["Lin's skills"].median <= 100 and trials["CQ-L"].median <= 500
    assert trials["flat Q-learning"].median >= 1000
    assert trials["CQ-L, K = 0"].median >= 3 * trials["CQ-L"].median  # the control that must fail
