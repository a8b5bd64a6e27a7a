"""A learner is one file, a target rule a function and a record: everything that offers a choice finds them by these.

Mutants that must die here: a list of learners or rules anywhere between the record and the command line · a record that
is found twice and taken once · a question about the class of the settings in runs/ or lab/.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import neuralq.learners
from neuralq.learners import LearnerKind, learner_kinds
from neuralq.rules import TargetRule, target_rules
from neuralq.rules.records import discovered
from neuralq.runs import RunConfig
from neuralq.runs.recipe.config import LEARNERS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("room", ["runs", "lab", "apps"])
def test_nobody_asks_for_the_class_of_a_learner_or_of_its_settings(room: str) -> None:
    ours = {kind.settings.__name__ for kind in LEARNERS.values()}
    ours |= {name for name in neuralq.learners.__all__ if name.endswith(("Learner", "Settings")) and name != "Learner"}
    offences = []
    for path in (ROOT / "neuralq" / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
                named = {x.id for x in ast.walk(node.args[1]) if isinstance(x, ast.Name)}
                offences += [f"{path}:{node.lineno}" for _ in named & ours]
    assert not offences


def test_every_learner_has_its_field_where_the_fields_were() -> None:
    names = [f.name for f in dataclasses.fields(RunConfig)]
    first = names.index("dueling") + 1
    assert names[first : first + len(LEARNERS)] == list(LEARNERS) and names[first + len(LEARNERS)] == "evaluate_every"
    for name, kind in learner_kinds().items():
        assert RunConfig(learner=name).settings == kind.settings() and kind.title and kind.source


def test_two_records_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from neuralq.learners import rollout

    monkeypatch.setattr(rollout, "AGAIN", dataclasses.replace(rollout.ROLLOUT, title="another"), raising=False)
    with pytest.raises(ValueError, match="two records of LearnerKind are named 'rollout'"):
        discovered("neuralq.learners", LearnerKind)
    monkeypatch.setattr(rollout, "AGAIN", rollout.ROLLOUT)
    assert list(discovered("neuralq.learners", LearnerKind)) == list(LEARNERS)
    monkeypatch.setattr(rollout, "AGAIN", dataclasses.replace(rollout.ROLLOUT, name="again"))
    assert list(discovered("neuralq.learners", LearnerKind))[:2] == ["again", "rollout"]  # of one place by the alphabet
    assert list(LEARNERS)[:5] == ["rollout", "replay", "online", "streaming", "gradient"]


def test_a_learner_says_which_experience_it_takes() -> None:
    with pytest.raises(ValueError, match="experience of the learner 'rollout' must be one of 'rollouts', 'replay'"):
        dataclasses.replace(LEARNERS["rollout"], experience="dreams")


# A learner of one's own: one file in a folder of its own, and nothing else.

NEARSIGHTED = '''
"""Every state's value moves a step towards the reward: a learner for a test."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from neuralq.learners import LearnerKind, Traits, Update


@dataclass(frozen=True)
class NearsightedSettings:
    """How it learns.

    Args:
        step_size: how far a value moves towards the reward.
    """

    step_size: float = 0.5


class Nearsighted:
    def __init__(self, engine: Any, settings: NearsightedSettings) -> None:
        self.engine, self.settings, self.num_updates = engine, settings, 0

    def update(self, transition: Any, weight: Any = None) -> Update:
        target = transition.r_t.to(self.engine.flat.values.dtype)
        errors = self.engine.loss_gradient(transition.s_tm1, transition.a_tm1, target, weight)
        self.engine.flat.values.add_(self.engine.flat.grad, alpha=-self.settings.step_size)
        self.num_updates += 1
        return Update(errors, target)

    def begin_streams(self) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {"num_updates": self.num_updates, "parameters": self.engine.flat.values}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.num_updates = int(state["num_updates"])
        self.engine.flat.load(torch.as_tensor(state["parameters"]))


NEARSIGHTED = LearnerKind(
    name="nearsighted",
    title="sees no further than the reward",
    source="this test",
    settings=NearsightedSettings,
    build=lambda parts: Nearsighted(parts.engine, parts.settings),
    experience="steps",
    traits=lambda s: Traits(s.step_size),
)
'''

COMMANDS = """
import contextlib, io, json
from neuralq.apps.cli import main
said = []
for argv in json.loads(sys.argv[2]):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(argv) == 0
    said.append(out.getvalue())
print(json.dumps(said))
"""


def said_by(folder: Path, room: str, program: str, *argv: str) -> str:
    """What a program of its own says where the files of a folder stand beside those of ``neuralq.{room}``."""
    script = f"import sys, neuralq.{room}\nneuralq.{room}.__path__.append(sys.argv[1])\n"
    command = [sys.executable, "-W", "error", "-c", script + program, str(folder), *argv]
    paths = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'envs'}"}
    result = subprocess.run(command, cwd=ROOT, env=paths, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_a_learner_in_a_file_of_its_own_is_offered_trains_and_resumes(tmp_path: Path) -> None:
    (tmp_path / "nearsighted.py").write_text(NEARSIGHTED)
    train = ["train", "CartPole-v1", "--learner", "nearsighted", "--layout", "linear", "--preset", "false"]
    train += ["--evaluation-episodes", "1", "--epsilon-decay-steps", "50", "--nearsighted.step-size", "0.25", "--json"]
    parts, whole = (["--run-dir", str(tmp_path / name)] for name in ("parts", "whole"))
    commands = [
        [*train, "--help"],
        [*train, "--total-steps", "60", *parts],
        ["resume", parts[1], "--total-steps", "120", "--json"],
        [*train, "--total-steps", "120", *whole],
    ]
    offered, *runs = json.loads(said_by(tmp_path, "learners", COMMANDS, json.dumps(commands)))
    assert "{rollout,replay,online,streaming,gradient,tabular,nearsighted}" in offered
    assert "sees no further than the reward: this test" in offered
    assert "--nearsighted.step-size X" in offered and "how far a value moves towards the reward" in offered
    assert json.loads((tmp_path / "parts" / "config.json").read_text())["nearsighted"] == {"step_size": 0.25}
    first, resumed, straight = (json.loads(out.splitlines()[-1])["parameters_sha256"] for out in runs)
    assert resumed == straight != first


@pytest.mark.slow
def test_a_learner_in_a_file_of_its_own_is_used_from_python(tmp_path: Path) -> None:
    (tmp_path / "nearsighted.py").write_text(NEARSIGHTED)
    program = """
import neuralq
from neuralq.learners.nearsighted import NearsightedSettings
from neuralq.lab.watch.advice import RunTraits
config = neuralq.RunConfig(learner="nearsighted", nearsighted=NearsightedSettings(0.125), layout="linear",
                           total_steps=40, evaluation_episodes=1)
run = neuralq.train(config, sys.argv[1] + "/run")
print(run.env_steps, run.engine, neuralq.load(run.run_dir).values([0.0, 0.0, 0.0, 0.0]).shape)
print(RunTraits.of(config).step_size)
try:
    neuralq.RunConfig(learner="rollout", nearsighted=NearsightedSettings())
except ValueError as error:
    print(error)
"""
    assert said_by(tmp_path, "learners", program).splitlines() == [
        "40 torch (2,)",
        "0.125",
        "settings for the nearsighted learner would be ignored with learner='rollout'; use learner='nearsighted' or "
        "leave them out",
    ]


# A target rule of one's own: a function and a record.

HALFWAY = '''
"""Between the best action and any: a target rule for a test."""

from neuralq.checks import check_fraction
from neuralq.rules.policies import epsilon_greedy
from neuralq.rules.target_rule import Followed, Option, TargetRule

HALFWAY = TargetRule(
    name="halfway",
    title="between the best action and any",
    source="this test",
    follows=lambda seen: Followed(pi=epsilon_greedy(seen.q_t, seen.options["halfway_share"])),
    options={"halfway_share": Option(0.5, check_fraction, "how far towards any action", "goes no half ways")},
)
'''
TRIED = """
import json
import neuralq
from neuralq.learners import ReplaySettings
for distribution in ({}, {"distribution": "quantile"}, {"distribution": "categorical", "value_min": 0, "value_max": 9}):
    config = neuralq.with_preset({
        "env": "CartPole-v1", "learner": "replay", "body": {"class": "MLP", "hidden": [8]}, "total_steps": 30,
        "evaluation_episodes": 1, "replay": {"target_rule": "halfway", "learning_starts": 10, **distribution},
    })
    print(config.replay.halfway_share, neuralq.train(config, sys.argv[1] + "/" + str(len(distribution))).env_steps)
for given in ({"halfway_share": 0.5}, {"target_rule": "halfway", "halfway_share": 2.0}):
    try:
        ReplaySettings(**given)
    except ValueError as error:
        print(error)
"""


@pytest.mark.slow
def test_a_target_rule_in_a_file_of_its_own_is_learned_with_every_distribution(tmp_path: Path) -> None:
    (tmp_path / "halfway.py").write_text(HALFWAY)
    assert said_by(tmp_path, "rules", TRIED).splitlines() == [
        *("0.5 30", "0.5 30", "0.5 30"),
        "halfway_share=0.5 would be ignored: target_rule='q_learning' goes no half ways; leave halfway_share out",
        "halfway_share must lie in [0, 1], got 2.0",
    ]
    train = ["train", "CartPole-v1", "--learner", "replay", "--replay.target-rule", "halfway", "--total-steps", "30"]
    train += ["--replay.halfway-share", "0.25", "--replay.learning-starts", "10", "--hidden", "8", "--json"]
    commands = [[*train, "--help"], [*train, "--evaluation-episodes", "1", "--run-dir", str(tmp_path / "run")]]
    offered, _ = json.loads(said_by(tmp_path, "rules", COMMANDS, json.dumps(commands)))
    assert "how far towards any action" in offered and '"halfway" (this test)' in offered
    assert json.loads((tmp_path / "run" / "config.json").read_text())["replay"]["halfway_share"] == 0.25


def test_a_rule_that_follows_nothing_refuses_distributions_and_one_that_says_nothing_is_none() -> None:
    rule = TargetRule("dream", "", "", mean=lambda seen: seen.r_t)
    assert rule.refuses["distribution"].startswith("target_rule='dream' mixes means and")
    with pytest.raises(ValueError, match="'dream' says neither what it follows nor what its mean is"):
        dataclasses.replace(rule, mean=None)
    dqrc = target_rules()["dqrc"]
    assert dqrc.refuses["distribution"].startswith("dqrc corrects the gradient of a squared error")
    with pytest.raises(ValueError, match="corrects the gradient instead of freezing its targets; its learner knows"):
        dqrc.target(None)  # type: ignore[arg-type]


@pytest.mark.parametrize("room", ["learners", "runs", "lab"])
def test_nobody_compares_the_name_of_a_target_rule(room: str) -> None:
    offences = []
    for path in (ROOT / "neuralq" / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare) and "target_rule" in {getattr(x, "attr", "") for x in ast.walk(node)}:
                offences.append(f"{path.relative_to(ROOT)}: {ast.unparse(node)}")
    assert not offences
