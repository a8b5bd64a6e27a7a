"""Rules as units: what each says in every state, by logic written out here, and runs that begin with them.

Mutants that die here: a threshold by half a condition off, a margin of another size, a condition that is false counted
from the wrong end, the unit of another action on, a value with the wrong sign, given to another action or to all
networks, a tanh unit without its constant, a layer that passes on too little, units that listen to others, the network
itself changed, rules that are lost on the way to a run, inserted twice when it is loaded, or left out of the weights
that another run begins with; a sharper or a flatter sigmoid, and one whose slope is that of tanh.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import neuralq
from neuralq.apps.cli import main
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, DuelingQ, MaskedQ, Rule, SeparateQ, TableQ, insert_rules
from neuralq.runs.recipe.config import config_from_dict, config_to_dict

LAYOUTS: tuple[Any, ...] = (ActionOutputQ, SeparateQ, ActionInputQ)
# Inputs 0 and 2 are bits; input 3 is false at .5 and true at .25.
RULES = (
    Rule({0: True, 2: False, 3: (0.5, 0.25)}, action=1, value=2.5),
    Rule({0: True, 2: True, 3: (0.5, 0.25)}, action=0, value=-1.5, at_least=2),
    Rule({0: False}, action=1, value=0.5),
)
STATES = torch.tensor(list(itertools.product((0.0, 1.0), (0.3,), (0.0, 1.0), (0.5, 0.25))), dtype=torch.float64)
NUM_TRUE = [[int(s[0]) + int(not s[2]) + int(s[3] == 0.25), int(s[0]) + int(s[2]) + int(s[3] == 0.25), int(not s[0])]
            for s in STATES.tolist()]  # fmt: skip
"""Of the conditions of each rule, in each state."""


def sigmoid(z: float) -> float:
    return 1 / (1 + math.exp(-z))


def said(activation: str, depth: int, true: int, needed: int) -> float:
    """What a rule's last unit says of its value."""
    if activation in ("relu", "leaky_relu"):
        count = float(true - needed + 1)
        return count if count > 0 else count * 0.01**depth * (activation == "leaky_relu")
    share = sigmoid(6 * (true - needed + 0.5))
    for _ in range(depth - 1):  # such that .9526 and .0474 stay what they are
        steep = 3 / (sigmoid(3) - 0.5) if activation == "sigmoid" else 2 * 1.5 / math.tanh(1.5)
        share = sigmoid(steep * (share - 0.5) if activation == "sigmoid" else steep * (2 * share - 1))
    return share


@pytest.mark.parametrize("hidden", [(5,), (5, 4)])
@pytest.mark.parametrize("activation", ["sigmoid", "tanh", "relu", "leaky_relu"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_value_moves_by_what_the_rules_say(layout: Any, activation: str, hidden: tuple[int, ...]) -> None:
    q = layout(4, 3, MLP(hidden, activation=activation), rng=1, dtype=torch.float64)
    before = [p.clone() for p in q.parameters()]
    told = insert_rules(q, RULES)
    moved, wanted = (told.all(STATES) - q.all(STATES)).detach(), torch.zeros(len(STATES), 3, dtype=torch.float64)
    for i, counts in enumerate(NUM_TRUE):
        for rule, true in zip(RULES, counts, strict=True):
            for a in range(3):
                missing = 0
                if a != rule.action:  # where the action is an input, all conditions together are not enough
                    missing = len(rule.conditions) - rule.num_needed + 1
                if a == rule.action or layout is ActionInputQ:
                    wanted[i, a] += rule.value * said(activation, len(hidden), true - missing, rule.num_needed)
    torch.testing.assert_close(moved, wanted, rtol=0, atol=1e-12)
    assert all(torch.equal(a, b) for a, b in zip(before, q.parameters(), strict=True)) and type(told) is layout
    holds = torch.stack([rule.holds(STATES) for rule in RULES], 1).tolist()
    assert holds == [[n >= r.num_needed for n, r in zip(row, RULES, strict=True)] for row in NUM_TRUE]


def test_units_say_what_was_published() -> None:
    """Of a sigmoid unit: .9526 at least where its rule holds, and .0474 at most elsewhere, whatever the logic."""
    for num, needed in ((1, 1), (2, 2), (4, 4), (4, 2), (5, 1)):
        rule = Rule({i: i % 2 == 0 for i in range(num)}, 0, at_least=needed)
        for depth in (1, 3):
            q = ActionOutputQ(num, 1, MLP((3,) * depth, activation="sigmoid"), rng=0, dtype=torch.float64)
            s = torch.tensor(list(itertools.product((0.0, 1.0), repeat=num)), dtype=torch.float64)
            unit = (insert_rules(q, [rule]).all(s) - q.all(s))[:, 0].detach()
            assert unit[rule.holds(s)].min() >= 0.9526 - 5e-5 and unit[~rule.holds(s)].max() <= 0.0474 + 5e-5
        assert float(unit[rule.holds(s)].min()) == pytest.approx(0.9526, abs=5e-5)
    relu = ActionOutputQ(2, 2, MLP((8,)), rng=0)
    s = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    assert torch.equal(insert_rules(relu, [Rule({0: True, 1: False}, 1, 3.0)]).all(s), relu.all(s))  # to the bit


def test_rules_go_under_a_mask_and_can_be_learned_about() -> None:
    q = MaskedQ(ActionOutputQ(4, 3, MLP((5,), activation="sigmoid"), rng=1, dtype=torch.float64), (4,))
    told = insert_rules(insert_rules(q, RULES[:1]), RULES[1:])
    once = insert_rules(q, RULES)
    s = torch.cat([STATES, torch.ones(len(STATES), 3, dtype=torch.float64)], 1)
    torch.testing.assert_close(told.all(s), once.all(s))
    told.inner.at(STATES, torch.ones(len(STATES), dtype=torch.int64)).sum().backward()
    first = told.inner.trunk.layers[0]
    assert isinstance(first.weight, torch.nn.Parameter) and told.inner.trunk.sizes == (4, 8, 3)
    assert first.weight.grad[0, 1, 5] != 0  # an input that the first rule does not name may come to count


NET = ActionOutputQ(3, 2, MLP((4,)), rng=0)


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: Rule({}, 0), "a rule needs a condition, got none"),
        (lambda: Rule(((1, 0.0, 1.0), (1, 1.0, 0.0)), 0), r"reads each input once, got conditions on inputs \[1, 1\]"),
        (lambda: Rule({1: (2.0, 2.0)}, 0), r"two different numbers .*, got \(2.0, 2.0\) for input 1"),
        (lambda: Rule({1: "yes"}, 0), "a condition is true, false, or two"),  # type: ignore[dict-item]
        (lambda: Rule({1: 1}, 0), "got 1 for input 1"),  # type: ignore[dict-item]
        (lambda: Rule({-1: True}, 0), "the input of a condition must be a whole number"),
        (lambda: Rule("x", 0), "conditions are a mapping of inputs"),  # type: ignore[arg-type]
        (lambda: Rule([3], 0), r"as in \{3: True\}, got 3"),  # type: ignore[list-item]
        (lambda: Rule({1: True}, -1), "action must be a whole number"),
        (lambda: Rule({1: True}, 0, math.inf), "value must be finite"),
        (lambda: Rule({1: True}, 0, at_least=2), "at_least must be at most the number of conditions, 1, got 2"),
        (lambda: insert_rules(NET, [Rule({3: True}, 0)]), "reads input 3, and there are 0 to 2"),
        (lambda: insert_rules(NET, [Rule({1: True}, 2)]), "advises action 2, and there are 0 to 1"),
        (lambda: insert_rules(TableQ(3, 2), []), "without dueling or a distribution; this is TableQ"),
        (lambda: insert_rules(DuelingQ(3, 2), []), "this is DuelingQ"),
        (lambda: insert_rules(ActionOutputQ((10, 10), 2, Conv()), []), "take an MLP for a body"),
        (lambda: insert_rules(ActionOutputQ(3, 2, MLP(())), []), "has no hidden layer; give its body a width"),
        (lambda: insert_rules(ActionOutputQ(3, 2, MLP((4,), True)), []), "take a body with layer_norm=False"),
        (lambda: neuralq.RunConfig(rules=({"conditions": {1: True}},)), "a rule needs conditions and an action"),
        (lambda: neuralq.RunConfig(rules=({"if": {1: True}},)), "a rule has unknown keys if; known are action"),
        (lambda: neuralq.RunConfig(rules=(3,)), r"rules\[0\] must be a Rule or a mapping, got 3"),
        (lambda: neuralq.RunConfig(rules=(RULES[0],), layout="table"), "a table has no units that rules could be"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        act()


# ------------------------------------------------------------------------------------------------------- in whole runs

# Balance, told plainly: push to where the pole falls, by its angle and by its angular velocity.
BALANCE = (
    Rule({2: (-0.02, 0.02), 3: (-0.5, 0.5)}, action=1, value=3.0, at_least=1),
    Rule({2: (0.02, -0.02), 3: (0.5, -0.5)}, action=0, value=3.0, at_least=1),
)
SMALL: dict[str, Any] = {
    "preset": False, "total_steps": 64, "evaluate_every": 64, "evaluation_episodes": 4, "epsilon_decay_steps": 32,
    "num_envs": 2, "num_steps": 16, "learning_rate": 1e-30, "activation": "sigmoid",
}  # fmt: skip


@pytest.mark.whole
def test_a_run_begins_with_its_rules_and_is_loaded_with_them_once(tmp_path: Path) -> None:
    plain = neuralq.train("CartPole-v1", tmp_path / "plain", hidden=(8,), **SMALL)
    told = neuralq.train("CartPole-v1", tmp_path / "told", hidden=(8,), rules=BALANCE, **SMALL)
    config = neuralq.load(told), neuralq.load(plain)
    s = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32))
    expected = insert_rules(config[1].q, BALANCE).all(s)  # nothing was learned, and the weights are drawn alike
    torch.testing.assert_close(config[0].q.all(s), expected)
    assert told.greedy_return > 2 * plain.greedy_return
    late = neuralq.train(
        "CartPole-v1", tmp_path / "late", hidden=(8,), rules=BALANCE, warm_start=plain, seed=5, **SMALL
    )
    torch.testing.assert_close(neuralq.load(late).q.all(s), expected)
    again = neuralq.resume(late, total_steps=128)
    torch.testing.assert_close(neuralq.load(again).q.all(s), expected)


def test_rules_come_from_a_file_and_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = neuralq.RunConfig(rules=BALANCE)
    assert config_from_dict(config_to_dict(config)) == config
    text = "[{conditions: {2: [-0.02, 0.02], 3: [-0.5, 0.5]}, action: 1, value: 3, at_least: 1}]"
    assert main(["train", "CartPole-v1", "--preset", "false", "--rules", text, "--print-config"]) == 0
    (tmp_path / "run.yaml").write_text(capsys.readouterr().out)
    assert main(["train", "--config", str(tmp_path / "run.yaml"), "--print-config"]) == 0
    assert capsys.readouterr().out == (tmp_path / "run.yaml").read_text()
    for given, said in (
        ("[{action: 1}]", "a rule needs conditions"),
        ("[3]", "[0] must be a mapping, got 3"),
        ("{", "--rules must be a list"),
    ):
        assert main(["train", "CartPole-v1", "--rules", given]) == 2
        error = capsys.readouterr().err
        assert said in error and len(error.splitlines()) == 1
