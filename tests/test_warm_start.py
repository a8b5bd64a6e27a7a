"""Runs that begin with the weights of another: they mean here what they meant there, or are refused by name.

Mutants that must die here: weights that are not taken, or not into the target network or the average · statistics of
observations left behind, or the first observation seen without them · a source that is needed once there is a
checkpoint · one that has changed and is taken · a shape that is broadcast or cut.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import neuralq
from neuralq.apps.cli import main
from neuralq.learners import ReplaySettings, RolloutSettings, StreamingSettings
from neuralq.q import MLP
from neuralq.runs import Run, RunConfig, load, resume, train
from neuralq.runs.folder.checkpoint import load_newest
from neuralq.runs.folder.run_folder import read_config

S = [-0.5, 0.01]
NOTHING = 1e-30  # a step size too small for float32 to move anything by


def configuration(**given: Any) -> RunConfig:
    small = {
        "total_steps": 64,
        "evaluate_every": 32,
        "evaluation_episodes": 1,
        "checkpoint_every": 500,
        "log_every": 32,
    }
    more = {"env": "MountainCar-v0", "evaluation_max_steps": 5, "body": MLP((4,)), "epsilon_decay_steps": 32}
    return RunConfig(**{**small, **more, **given})


def replay(rate: float = 5e-4, **given: Any) -> RunConfig:
    settings = ReplaySettings(learning_starts=20, batch_size=8, learning_rate=rate, target_period_updates=500)
    return configuration(learner="replay", replay=settings, **given)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train(replay(seed=1), tmp_path_factory.mktemp("source") / "run")


class First:
    """Keeps the values before anything was learned."""

    values: Any = None

    def on_step(self, session: Any) -> None:
        if self.values is None:
            self.values = session.values(S)


@pytest.mark.parametrize("learner", ["replay", "rollout, averaged"])
def test_a_run_begins_with_the_weights_of_another_in_every_copy(source: Run, tmp_path: Path, learner: str) -> None:
    settings = RolloutSettings(num_envs=2, num_steps=8, learning_rate=NOTHING, optimiser="sgd", average_updates=4.0)
    config = replay(NOTHING) if learner == "replay" else configuration(rollout=settings)
    path = tmp_path / "run"
    run = neuralq.train(config, path, [first := First()], warm_start=source)
    assert np.array_equal(first.values, load(source).values(S))
    assert np.array_equal(load(path).values(S), load(source).values(S))
    kept = read_config(path)["warm_start"]
    assert kept == f"{source.run_dir}@sha256:{source.parameters_sha256}" and run.parameters_sha256 == kept[-64:]
    state = load_newest(path / "checkpoints").state["learner"]
    if learner == "replay":
        assert torch.equal(state["descent"]["target"], state["descent"]["parameters"])
    assert train(config, tmp_path / "alone").parameters_sha256 != run.parameters_sha256


def test_what_was_known_of_observations_comes_along(tmp_path: Path) -> None:
    settings = StreamingSettings(step_size=NOTHING, bound="obgd")
    config = configuration(learner="streaming", streaming=settings, layout="linear", body=None)
    one = train(config, tmp_path / "one")
    other = train(config, tmp_path / "other", warm_start=tmp_path / "one", total_steps=1, seed=5)
    counts = [
        load_newest(run.run_dir / "checkpoints").state["stream"]["normalisation"]["observation_count"][0]
        for run in (one, other)
    ]
    assert counts[1] == counts[0] + 2  # the first observation and the one after the only step
    plain = configuration(layout="linear", body=None, rollout=RolloutSettings(num_envs=2, num_steps=8))
    with pytest.raises(ValueError, match="normalised observations is True there and False here; take the same"):
        train(plain, tmp_path / "plain", warm_start=one)
    assert not (tmp_path / "plain").exists()


def test_the_source_is_needed_until_there_is_a_checkpoint(source: Run, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(source.run_dir, tmp_path / "copy"))
    whole = train(replay(total_steps=96, warm_start=str(copy)), tmp_path / "whole")
    train(replay(warm_start=str(copy)), tmp_path / "run")
    lost = Path(shutil.copytree(tmp_path / "run", tmp_path / "lost"))
    shutil.rmtree(lost / "checkpoints")
    assert resume(lost, 96).parameters_sha256 == whole.parameters_sha256
    resume(copy, 80)
    shutil.rmtree(lost / "checkpoints")
    with pytest.raises(ValueError, match=f"{copy} has other weights than those that the run was to begin with"):
        resume(lost, 97)
    shutil.rmtree(copy)
    assert resume(tmp_path / "run", 96).parameters_sha256 == whole.parameters_sha256


def test_another_shape_is_refused_by_its_layer(
    source: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for given, said in (
        ({"body": MLP((5,))}, r"layer trunk.layers.0.weight has the shape \(1, 2, 4\) there and \(1, 2, 5\) here"),
        ({"body": MLP((4,), layer_norm=True)}, "the layer trunk.norms.0.weight is here and not there; take its body"),
        ({"body": MLP((4,), activation="tanh")}, "activation is relu there and tanh here"),
        ({"reward_scale": 0.5}, "reward_scale is 1.0 there and 0.5 here"),
        ({"env": "CartPole-v1"}, r"layer trunk.layers.0.weight has the shape \(1, 2, 4\) there and \(1, 4, 4\) here"),
    ):
        with pytest.raises(ValueError, match=said):
            train(replay(**given), tmp_path / "run", warm_start=source)
        assert not (tmp_path / "run").exists()
    words = [
        "--learner",
        "replay",
        "--hidden",
        "5",
        "--preset",
        "false",
        "--total-steps",
        "64",
        "--resume-probe",
        "false",
    ]
    status = main(["train", "MountainCar-v0", *words, "--warm-start", str(source.run_dir)])
    error = capsys.readouterr().err
    assert status == 1 and "cannot begin with the weights of" in error and "Traceback" not in error
    assert main(["train", "MountainCar-v0", *words, "--warm-start", "nowhere"]) == 1
    assert "there is no neuralq run in nowhere" in capsys.readouterr().err
