"""Learning from recorded experience: what is read, what is learned from it, and that going on is exact.

Mutants that must die here: a successor taken over an episode's end · a cut episode's last step bootstrapped from the
next episode · a discount at a termination · one budget step too many or too few per update · the buffer of a resumed
run another than before · a data set that changed and is taken.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import neuralq
from neuralq.apps.cli import main
from neuralq.exact import evaluate, solve
from neuralq.learners import ReplaySettings
from neuralq.mdp import FiniteMDP
from neuralq.q import MLP, LinearQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss
from neuralq.runs import RunConfig, load, resume, train
from neuralq.runs.estimate import estimate_policy, fitted_values, table_values
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.offline.files import read_recorded, write_recorded
from neuralq.runs.offline.playback import rows_of, whole_buffer
from neuralq.runs.offline.recorded import Recorded
from neuralq.runs.stream.encoding import encoder_for

GAMMA = 0.9
ENDS = (5, 7, 11, 12, 15)
LAKE = {"env": "FrozenLake-v1", "env_kwargs": {"is_slippery": False}}


def wander(env_id: str, num_steps: int, seed: int = 0, limit: int = 10**9, **kwargs: Any) -> Recorded:
    """Uniformly random steps, each episode cut after ``limit``; the successors are left out."""
    env, rng = gym.make(env_id, **kwargs), np.random.default_rng(seed)
    rows: list[tuple[Any, ...]] = []
    s, steps = env.reset(seed=seed)[0], 0
    while len(rows) < num_steps:
        a = int(rng.integers(env.action_space.n))  # type: ignore[attr-defined]
        s_t, r, terminated, truncated, _ = env.step(a)
        steps += 1
        rows.append((s, a, r, terminated, not terminated and (truncated or steps == limit)))
        s, steps = (env.reset()[0], 0) if terminated or rows[-1][-1] else (s_t, steps)
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Recorded(columns[0], columns[1], columns[2].astype(float), *columns[3:])


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Each action once in each state where the world goes on, which is no episode of anybody's."""
    path, model = tmp_path_factory.mktemp("data") / "lake.npz", gym.make("FrozenLake-v1", is_slippery=False).unwrapped.P  # type: ignore[attr-defined]
    rows = [(s, a, *model[s][a][0][1:]) for s in range(16) if s not in ENDS for a in range(4)]
    s, a, s_t, r, ended = (np.array(column) for column in zip(*rows, strict=True))
    write_recorded(path, Recorded(s, a, r.astype(float), ended, ~ended, s_t))
    return str(path)


def table(dataset: str, steps: int = 600, **given: Any) -> RunConfig:
    settings = {"optimiser": "sgd", "learning_rate": 30.0, "loss": "squared", "max_grad_norm": None, "batch_size": 256}
    replay = ReplaySettings(**{**settings, "target_period_updates": 20, **given})
    return RunConfig(
        **LAKE, learner="replay", replay=replay, layout="table", dataset=dataset, gamma=GAMMA, total_steps=steps,
        evaluate_every=600, evaluation_episodes=1, evaluation_max_steps=50, checkpoint_every=10**6,
    )  # fmt: skip


def exact() -> Any:
    return solve(FiniteMDP.from_gymnasium(gym.make("FrozenLake-v1", is_slippery=False)), gamma=GAMMA).q


@pytest.mark.parametrize("given", [{}, {"prioritised": True}], ids=["uniform", "prioritised"])
def test_what_is_learned_is_the_exact_answer_of_the_world_that_was_recorded(
    given: dict[str, Any], lake: str, tmp_path: Path
) -> None:
    run = train(table(lake, **given), tmp_path / "run")
    agent = load(run.run_dir)
    alive = [s for s in range(16) if s not in ENDS]
    assert np.array([agent.values(s) for s in alive]) == pytest.approx(exact()[alive], abs=1e-4)
    assert run.greedy_return == 1 and run.env_steps == 600
    rows = [row for row in read_metrics(run.run_dir) if row["kind"] == "train"]
    assert rows[-1]["num_updates"] == rows[-1]["env_steps"]


def test_lambda_returns_over_recorded_episodes_lead_there_too(tmp_path: Path) -> None:
    """Random steps and the greedy policy's returns of them (tree backup), where each action was taken often."""
    data = wander("FrozenLake-v1", 6000, is_slippery=False)
    write_recorded(path := tmp_path / "wandered.npz", data)
    given = {"target_rule": "tree_backup", "block_length": 8, "lambda_": 0.9, "target_epsilon": 1e-6}
    run = train(table(str(path), 1500, **given, optimiser="adam", learning_rate=0.02), tmp_path / "run")
    agent, counts = load(run.run_dir), np.zeros((16, 4))
    np.add.at(counts, (data.observations, data.actions), 1)
    found = np.array([agent.values(s) for s in range(16)])
    often = counts >= 30
    assert often.sum() > 15 and found[often] == pytest.approx(exact()[often], abs=0.02)


def test_successors_stay_within_episodes() -> None:
    """Two episodes, the first cut and the second ended, and a step that nobody finished."""
    s, flags = np.arange(6), np.zeros(6, bool)
    ended, cut = flags.copy(), flags.copy()
    ended[4], cut[2] = True, True
    data = Recorded(s, np.zeros(6, int), np.arange(6.0), ended, cut)
    encoder = encoder_for(gym.spaces.Discrete(9))
    s_tm1, _, mu, r, discount, s_t, last = rows_of(data, encoder, 0, 1, GAMMA)
    assert s_tm1.tolist() == [0, 1, 3, 4] and s_t[:3].tolist() == [1, 2, 4]  # of step 2 and of step 5 nobody knows
    assert discount.tolist() == [GAMMA, GAMMA, GAMMA, 0] and last.tolist() == [False, True, False, True]
    assert r.tolist() == [0, 1, 3, 4] and mu.tolist() == [1] * 4
    whole = Recorded(s, data.actions, data.rewards, ended, cut, next_observations=s + 1)
    rows = rows_of(whole, encoder, 0, 1, GAMMA)
    assert rows[5].tolist() == [1, 2, 3, 4, 5, 6] and rows[6].tolist() == [False, False, True, False, True, True]
    assert rows[4].tolist() == [GAMMA] * 4 + [0, GAMMA]
    settings = ReplaySettings(num_steps=3)
    drawn = whole_buffer(rows, settings).sample(200, np.random.default_rng(0)).transition
    found = {(int(a), round(float(b), 4), int(c)) for a, b, c in zip(drawn.s_tm1, drawn.r_t, drawn.s_t, strict=True)}
    # Step 0: 0 + .9 + .81 · 2; step 1: 1 + .9 · 2; step 2 alone; step 3: 3 + .9 · 4; step 4 and step 5 alone.
    assert found == {(0, 2.52, 3), (1, 2.8, 3), (2, 2, 3), (3, 6.6, 5), (4, 4, 5), (5, 5, 6)}


@pytest.mark.parametrize("prioritised", [False, True])
def test_a_run_goes_on_bit_for_bit_and_not_with_other_data(prioritised: bool, lake: str, tmp_path: Path) -> None:
    path = tmp_path / "lake.npz"
    path.write_bytes(Path(lake).read_bytes())
    given = {"prioritised": prioritised, "train_period": 3, "num_steps": 2}
    whole = train(table(str(path), 90, **given), tmp_path / "whole")
    train(table(str(path), 45, **given), tmp_path / "run")
    assert resume(tmp_path / "run", 90).parameters_sha256 == whole.parameters_sha256
    write_recorded(path, wander("FrozenLake-v1", 50, seed=1, is_slippery=False))
    with pytest.raises(ValueError, match="is not the one that the run learned from"):
        resume(tmp_path / "run", 120)


def test_a_network_learns_from_a_file_and_minari_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = wander("CartPole-v1", 300)
    write_recorded(tmp_path / "cart.npz", data)
    monkeypatch.chdir(tmp_path)
    words = [
        "--learner",
        "replay",
        "--preset",
        "false",
        "--hidden",
        "8",
        "--total-steps",
        "60",
        "--evaluation-episodes",
    ]
    words += ["1", "--replay.conservative-alpha", "0.5", "--dataset", "cart.npz", "--run-dir", "run"]
    assert main(["train", "CartPole-v1", *words]) == 0
    assert "learning from cart.npz: 300 steps in" in capsys.readouterr().err
    small = {"hidden": (8,), "preset": False, "total_steps": 60, "evaluation_episodes": 1, "learner": "replay"}
    plain = neuralq.train("CartPole-v1", "plain", dataset="cart.npz", **small)
    assert not torch.equal(*(torch.tensor(load(run).values(np.zeros(4))) for run in ("run", plain)))


def test_a_tables_estimate_is_the_exact_value_in_the_empirical_model(lake: str, tmp_path: Path) -> None:
    """The means of what was recorded on slippery ice, made a model of, which neuralq.exact evaluates."""
    train(table(lake, 200), tmp_path / "run")
    agent, data = load(tmp_path / "run"), wander("FrozenLake-v1", 3000, limit=40, seed=3)
    data = dataclasses.replace(data, rewards=np.random.default_rng(0).normal(1, 1, 3000))
    counts, rewards = np.zeros((4, 17, 17)), np.zeros((17, 4))
    for s, a, r, ended, s_t in zip(
        *(column[data.known] for column in (data.observations, data.actions, data.rewards, data.terminations)),
        data.successors[data.known], strict=True,
    ):  # fmt: skip
        counts[a, s, 16 if ended else s_t] += 1
        rewards[s, a] += r
    total = counts.sum(-1)
    p = np.where(total[..., None] > 0, counts / np.maximum(total, 1)[..., None], np.eye(17)[16])
    policy = [*(agent.predict(s) for s in range(16)), 0]
    v = evaluate(FiniteMDP.from_arrays(p, rewards / np.maximum(total.T, 1)), policy, gamma=GAMMA)
    config = table(lake)
    found = estimate_policy(agent, config, data)
    assert found.value == pytest.approx(v[0], abs=1e-12) and found.value > 1
    assert found.low is not None and found.high is not None and found.low < found.value < found.high
    assert found.num_episodes == data.num_episodes and found.num_steps == int(total.sum())
    lonely = estimate_policy(agent, config, Recorded(*(getattr(data, n)[:1] for n in data.arrays())))
    assert lonely.value == 0 and lonely.low is None and lonely.unseen_share is not None


def test_a_fit_comes_to_what_the_table_says() -> None:
    """A ring of four states with one way round, a reward of 1 in one of them, seen as one-hot vectors."""
    s = np.tile(np.arange(4), 40)
    r, gamma, one_hot = (s == 2).astype(float), 0.8, np.eye(4, dtype=np.float32)
    wanted = table_values(4, s, r, np.full(160, gamma), (s + 1) % 4)
    assert wanted == pytest.approx(gamma ** np.array([2.0, 1, 0, 3]) / (1 - gamma**4))
    engine = make_engine(LinearQ(4, 2, bias=False), Loss())
    rows = one_hot[s], np.zeros(160, np.int64), r, np.full(160, gamma), one_hot[(s + 1) % 4]
    none = np.zeros(160, np.int64)
    found = fitted_values(engine, rows, none, one_hot, none[:4], gamma, np.random.default_rng(0), learning_rate=0.02)
    assert found == pytest.approx(wanted, rel=0.05)


def test_steps_are_recorded_read_learned_from_and_used_to_evaluate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    small = {"hidden": (8,), "preset": False, "total_steps": 60, "evaluation_episodes": 1, "learner": "replay"}
    neuralq.train("CartPole-v1", "run", **small)
    capsys.readouterr()
    assert main(["record", "run", "--to", "cart.npz", "--episodes", "4", "--epsilon", "0.3", "--json"]) == 0
    told, data = json.loads(capsys.readouterr().out), read_recorded("cart.npz")
    assert told["num_steps"] == len(data.actions) and told["num_episodes"] == data.num_episodes == 4
    assert set(np.round(data.probabilities, 6)) == {0.15, 0.85} and data.known.all()  # type: ignore[arg-type]
    assert (data.next_observations[:-1] == data.observations[1:])[~data.ends[:-1]].all()  # type: ignore[index]
    agent = load("run")
    greedy = np.array([agent.predict(s) for s in data.observations])
    assert ((data.probabilities > 0.5) == (greedy == data.actions)).all()
    pytest.importorskip("h5py"), pytest.importorskip("minari")
    assert main(["record", "run", "--minari", "cart/some-v0", "--episodes", "4", "--epsilon", "0.3"]) == 0
    assert "neuralq train CartPole-v1 --learner replay --dataset minari:cart/some-v0" in capsys.readouterr().out
    both = [neuralq.train("CartPole-v1", dataset=name, **small) for name in ("cart.npz", "minari:cart/some-v0")]
    assert both[0].parameters_sha256 == both[1].parameters_sha256
    monkeypatch.setattr("neuralq.runs.estimate._MOST_ITERATIONS", 3)
    assert main(["evaluate", "run", "--on", "minari:cart/some-v0"]) == 0
    assert "discounted value of the greedy policy" in capsys.readouterr().out
    for words, said in (
        (["--minari", "cart/some-v0"], "already exists"),
        (["--minari", "no id"], "an id is like cartpole/trained-v0"),
        (["--to", "data.csv"], "--to be a file.npz"),
        (["--to", "a.npz", "--gif", "a.gif"], "one at a time"),
        (["--gif", "a.gif", "--epsilon", "0.1"], "--epsilon is for recorded steps"),
    ):
        assert main(["record", "run", *words]) != 0
        assert said in capsys.readouterr().err
    assert main(["evaluate", "run", "--on", "minari:no/such-v0"]) == 1
    assert "minari list local names those on this machine" in capsys.readouterr().err


def test_what_is_no_data_set_of_the_environment_is_refused(lake: str, tmp_path: Path) -> None:
    data = wander("CartPole-v1", 30)
    arrays, path = data.arrays(), tmp_path / "bad.npz"

    def refused(said: str, config: RunConfig | None = None) -> None:
        with pytest.raises(ValueError, match=said):
            train(config or RunConfig(learner="replay", body=MLP((4,)), dataset=str(path)), tmp_path / "run")
        assert not (tmp_path / "run").exists()

    refused("cannot read the data set .*No such file")
    path.write_bytes(b"no archive")
    refused("cannot read the data set .*not a zip file")
    np.savez(path, **{**arrays, "actions": np.array([None] * 30)})
    refused("it holds Python objects, which are never loaded")
    np.savez(path, **{name: arrays[name] for name in ("observations", "actions")})
    refused("rewards and terminations missing, got actions, observations; a data set holds observations")
    for name, value, said in (
        ("actions", arrays["actions"] * 0.5, "actions must be whole numbers, got float64"),
        ("actions", arrays["actions"] + 5, "actions lie in 5 to 6, the environment's in 0 to 1"),
        ("rewards", arrays["rewards"][:5], r"rewards must have shape \(30,\), got \(5,\)"),
        ("rewards", arrays["rewards"] * np.nan, "rewards must be finite, step 0 is not"),
        ("terminations", arrays["actions"] + 5, "terminations must be true or false"),
        ("observations", arrays["observations"][:, :3], "the data set's observations are not the environment's"),
    ):
        np.savez(path, **{**arrays, name: value})
        refused(said)
    np.savez(path, **{**arrays, "terminals": arrays.pop("terminations"), "timeouts": arrays.pop("truncations")})
    assert read_recorded(str(path)).sha256() == data.sha256()
    np.savez(path, **data.arrays())
    retrace = ReplaySettings(target_rule="retrace", block_length=4)
    refused(
        "needs the probabilities with which actions were taken",
        RunConfig(learner="replay", replay=retrace, body=MLP((4,)), dataset=str(path)),
    )
    with pytest.raises(ValueError, match="the rollout learner takes no recorded experience; use learner='replay'"):
        RunConfig(dataset=lake)
    refused("a data set is minari:ID or a file.npz", RunConfig(learner="replay", dataset="data.hdf5"))
