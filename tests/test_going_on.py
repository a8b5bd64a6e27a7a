"""What a run goes on with: its own configuration, the arithmetic it had, and a budget that is not spent yet.

Mutants that must die here: a checkpoint of another seed taken · an edited rate taken · an upgraded library not named ·
a budget below what is spent written down · a finished run that says nothing · two runs in one folder · a setting that
means something else with several environments.
"""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
import warnings
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import neuralq
from neuralq.apps.cli import main
from neuralq.learners import RolloutSettings
from neuralq.runs import Run, RunConfig, evaluate_run, load, resume, train
from neuralq.runs.control import CONTROL
from neuralq.runs.folder import origin
from neuralq.runs.folder.checkpoint import CheckpointError, load_newest
from neuralq.runs.folder.run_folder import RunFolderError, claimed, default_run_path, read_config, read_metrics
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.sweep import create_sweep, perform
from neuralq_envs import CLASSIC

GRID = RunConfig(
    env="neuralq/MitchellGrid-v0", layout="table", total_steps=200, evaluate_every=100, evaluation_episodes=1,
    evaluation_max_steps=50, checkpoint_every=100, log_every=50, rollout=RolloutSettings(num_envs=2, num_steps=10),
)  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train(GRID, tmp_path_factory.mktemp("finished") / "run")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing a report takes longer than all the rest, and is not what is asked here."""
    monkeypatch.setattr("neuralq.apps.cli.runs.write_report", lambda path: path)


@pytest.fixture
def copy(finished: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished.run_dir, tmp_path / "run"))


def edited(path: Path, **values: Any) -> None:
    file = path / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


@pytest.fixture
def said_in_lines() -> Iterator[None]:
    """Warnings as a command shows them, and not as the errors that they are in tests."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        yield


# Another configuration


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("seed", 7, "seed was 0 there and is 7 here"),
        ("gamma", 0.5, "gamma was 0.99 there and is 0.5 here"),
        ("reward_scale", 2.0, "reward_scale was 1.0 there and is 2.0 here"),
        ("rollout", {"num_envs": 2, "num_steps": 10, "learning_rate": 0.5}, "rollout.learning_rate was"),
        ("epsilon_decay_steps", 7, "epsilon_decay_steps was 20000 there and is 7 here"),
        ("env", "FrozenLake-v1", "env was 'neuralq/MitchellGrid-v0' there"),
    ],
)
def test_a_checkpoint_of_another_configuration_is_refused_by_name(name: str, value: Any, told: str, copy: Path) -> None:
    edited(copy, **{name: value})
    with pytest.raises(CheckpointError, match="is of another configuration than config") as refused:
        resume(copy, total_steps=400)
    assert told in str(refused.value) and read_config(copy)["total_steps"] == 200
    for best in (False, True):
        with pytest.raises(CheckpointError, match="is of another configuration"):
            load(copy, best)


def test_checkpoints_and_best_parameters_of_another_seed_are_not_taken(copy: Path, tmp_path: Path) -> None:
    other = train(dataclasses.replace(GRID, seed=1), tmp_path / "other").run_dir
    for folder in ("checkpoints", "best"):
        shutil.rmtree(copy / folder)
        shutil.copytree(other / folder, copy / folder)
    with pytest.raises(CheckpointError, match="seed was 1 there and is 0 here"):
        resume(copy, total_steps=400)
    for best in (False, True):
        with pytest.raises(CheckpointError, match="seed was 1 there and is 0 here"):
            evaluate_run(copy, 1, best=best)


def test_a_changed_bit_of_the_configuration_never_goes_on_as_another_run(finished: Run, tmp_path: Path) -> None:
    written = (finished.run_dir / "config.json").read_bytes()
    saved = load_newest(finished.run_dir / "checkpoints").state["origin"]
    harmless = CONTROL.free | origin.ARITHMETIC
    rng, parsed = random.Random(1), 0
    for at in rng.sample(range(8 * len(written)), 500):
        changed = bytearray(written)
        changed[at // 8] ^= 1 << at % 8
        try:
            config = CONTROL.to_plain(CONTROL.from_plain(json.loads(changed)))
        except (ValueError, TypeError, RecursionError):
            continue
        if {k: v for k, v in config.items() if k not in harmless} != {
            k: v for k, v in CONTROL.to_plain(GRID).items() if k not in harmless
        }:
            parsed += 1
            with pytest.raises(CheckpointError, match="another configuration"):
                origin.compared(saved, config, "it")
    assert parsed >= 5  # so something was asked


def test_settings_of_the_environment_that_are_left_out_are_missed(tmp_path: Path) -> None:
    saved = origin.present({"env": "X", "env_kwargs": {"slip": 0.5}, "gamma": 0.9})
    with pytest.raises(CheckpointError, match=r"env_kwargs was \{'slip': 0.5\} there and is \{\} here"):
        origin.compared(saved, {"env": "X", "env_kwargs": {}, "gamma": 0.9}, "it")
    with pytest.raises(CheckpointError, match=r"gamma was 0\.9 there and is None here"):
        origin.compared(saved, {"env": "X", "env_kwargs": {"slip": 0.5}}, "it")
    later = {"env": "X", "env_kwargs": {"slip": 0.5}, "gamma": 0.9, "new_in_this_version": 1}
    assert origin.compared(saved, later, "it") is None
    assert origin.compared(None, later, "of a version that kept none") is None


# Another arithmetic


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("versions", "torch", "1.0.0"),
        ("arithmetic", "BLAS kernel of openblas", "Prescott 0.3"),
        pytest.param("arithmetic", "NUMBA_DISABLE_JIT", "1", marks=pytest.mark.slow),
        pytest.param("arithmetic", "instructions of torch", "DEFAULT", marks=pytest.mark.slow),
    ],
)
def test_what_decides_the_bits_and_differs_is_named_and_the_promise_is_taken_back_for_good(
    part: str, name: str, value: str, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = origin.present({})
    with monkeypatch.context() as patched:
        patched.setattr(origin, f"_{part}", lambda *_: {**here[part], name: value})
        with pytest.warns(UserWarning, match=f"not with the same bits for certain: .*{name} was .* and is {value}"):
            run = resume(copy, total_steps=300)
    assert "resumes bit-exact" not in run.resumability and f"and is {value}" in run.resumability
    with pytest.warns(UserWarning, match=f"{name} was {value} and is"):  # back again
        run = resume(copy, total_steps=400)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = resume(copy, total_steps=500)  # nothing differs from the last checkpoint, but from the first
    assert f"{name} was {value} and is" in run.resumability


def test_a_processor_that_lacks_something_is_named_and_older_checkpoints_lack_nothing() -> None:
    here = origin.present({})
    there = {**here, "arithmetic": {**here["arithmetic"], "features of the processor": "avx avx512f fma"}}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(
            origin, "_arithmetic", lambda *_: {**there["arithmetic"], "features of the processor": "avx fma sse"}
        )
        told = "the run is bit-exact on processors of the kind it was on; this one lacks avx512f and has sse beside"
        assert origin.compared(there, {}, "it") == told
        named = ("features of the processor", "C library", "instructions of NumPy")
        older = {n: value for n, value in there["arithmetic"].items() if n not in named}
        assert origin.compared({**there, "arithmetic": older}, {}, "it") is None


def test_the_promise_says_how_far_it_was_tried(finished: Run) -> None:
    assert finished.resumability.startswith("resumes bit-exact as far as 60 steps show")  # 50, and 10 after a reset


@pytest.mark.usefixtures("said_in_lines")
def test_a_run_moves_to_another_device_as_the_error_says(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in (copy / "config.json",):
        file.write_text(file.read_text().replace('"device": "cpu"', '"device": "cuda:77"'))
    assert main(["resume", str(copy), "--total-steps", "300"]) == 1
    error = capsys.readouterr().err
    assert "cannot compute on device 'cuda:77'" in error and "--device cpu" in error
    assert main(["resume", str(copy), "--total-steps", "300", "--device", "cpu"]) == 0
    captured = capsys.readouterr()
    assert read_config(copy)["device"] == "cpu"
    edited(copy, threads=2)
    with pytest.warns(UserWarning, match="threads was 1 and is 2"):
        resume(copy, total_steps=400)
    assert "Traceback" not in captured.err


def test_the_seeds_of_a_sweep_move_with_it(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = create_sweep(tmp_path / "sweep", {**read_config(copy), "device": "cuda:77"}, [0])
    shutil.copytree(copy, sweep.run_path(0))
    edited(sweep.run_path(0), device="cuda:77", stop_at_return=3.0)
    sweep.config["device"], sweep.config["stop_at_return"] = "cpu", None
    asked = list[Any]()
    monkeypatch.setattr(type(CONTROL), "resume", lambda kind, *words: asked.append(words))
    perform(sweep.task(next(sweep.members())))
    [(path, budget, _, changes)] = asked
    assert (path, budget) == (sweep.run_path(0), sweep.config["total_steps"])
    assert changes == {"device": "cpu", "stop_at_return": None}


# Budgets and targets


@pytest.mark.usefixtures("said_in_lines")
def test_a_reached_target_is_said_and_its_way_out_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run"
    reached = train(dataclasses.replace(GRID, stop_at_return=-1e9, total_steps=400), path)
    assert reached.reached and reached.env_steps < 400
    assert main(["resume", str(path)]) == 0
    said = capsys.readouterr().err
    assert f"has reached its target of -1e+09 at {reached.env_steps:,} env steps" in said
    way_out = said[said.index("neuralq resume") :].split("\n")[0].split()[1:]
    assert main([*way_out, "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["env_steps"] >= 400 and result["reached"] is None
    assert read_config(path)["stop_at_return"] is None
    plain = train(dataclasses.replace(GRID, total_steps=400), tmp_path / "plain")
    assert result["parameters_sha256"] == plain.parameters_sha256  # as if it had never had a target


@pytest.mark.usefixtures("said_in_lines")
def test_a_spent_budget_is_said_and_its_way_out_goes_on(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["resume", str(copy)]) == 0
    said = capsys.readouterr().err
    assert "has spent its budget of 200 env steps" in said
    way_out = said[said.index("neuralq resume") :].split("\n")[0].split()[1:]
    assert main([*way_out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["env_steps"] == 400


def test_a_target_that_the_last_evaluation_met_is_met(copy: Path, finished: Run) -> None:
    with pytest.warns(UserWarning, match="has reached its target"):
        assert resume(copy, stop_at_return=finished.greedy_return).reached
    with pytest.warns(UserWarning, match="has spent its budget"):
        assert resume(copy, stop_at_return=1e9).reached is False


def test_a_budget_below_what_is_spent_is_refused_and_changes_nothing(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["resume", str(copy), "--total-steps", "100"]) == 1
    assert "total_steps=100 is less than what" in (error := capsys.readouterr().err) and "has spent, 200" in error
    assert read_config(copy)["total_steps"] == 200
    with pytest.raises(ValueError, match="gamma cannot be changed where a run on an environment goes on"):
        resume(copy, gamma=0.5)


# Names


def test_runs_that_begin_within_a_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    second = datetime(2024, 5, 17, 9, 30)
    monkeypatch.setattr(
        "neuralq.runs.control.default_run_path",
        lambda env, layout, seed, _: default_run_path(env, layout, seed, second),
    )
    config = dataclasses.replace(GRID, total_steps=20)
    names = [neuralq.train(config).run_dir.name for _ in range(3)]
    assert names[1:] == [f"{names[0]}-2", f"{names[0]}-3"]
    with pytest.raises(ValueError, match="cannot make the environment"):
        neuralq.train(dataclasses.replace(config, env="NoSuchThing-v0"))
    with pytest.raises(RunFolderError, match="already holds a run"):
        neuralq.train(config, tmp_path / "runs" / names[0])
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == sorted(names)  # nothing empty is left
    with claimed("named", lambda: tmp_path) as path:
        assert path == Path("named") and not path.exists()


# The same settings everywhere


class Wrapped(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    def __init__(self, env: Any) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def step(self, action: Any) -> Any:
        observation, reward, *rest = self.env.step(action)
        return observation, 10 * float(reward), *rest


class Silent(gym.vector.VectorEnv[Any, Any, Any]):  # does not say how it restarts
    def __init__(self, num_envs: int = 1, **_: Any) -> None:
        self.num_envs, self.metadata = num_envs, {}


def of_vectors_only(num_envs: int, **given: Any) -> Any:
    from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv

    return CartPoleVectorEnv(num_envs, **given)


@pytest.fixture(scope="module", autouse=True)
def registered() -> Any:
    entry = "gymnasium.envs.classic_control.cartpole:"
    one, many = f"{entry}CartPoleEnv", f"{entry}CartPoleVectorEnv"
    wrapper = gym.envs.registration.WrapperSpec("Wrapped", f"{__name__}:Wrapped", {})
    gym.register("Wrapped-v0", entry_point=one, vector_entry_point=many, additional_wrappers=(wrapper,))
    gym.register("Silent-v0", entry_point=one, vector_entry_point=f"{__name__}:Silent", max_episode_steps=500)
    gym.register("Loose-v0", entry_point=one, vector_entry_point=many, order_enforce=False, max_episode_steps=9)
    gym.register("Vectors-v0", vector_entry_point=f"{__name__}:of_vectors_only", max_episode_steps=9)
    yield
    for name in ("Wrapped", "Silent", "Loose", "Vectors"):
        gym.registry.pop(f"{name}-v0")


def courses(env: str, env_kwargs: dict[str, Any], num_envs: int) -> tuple[float, float]:
    """Length and return of the first episode under actions 0, 1, 0, 1, …"""
    envs = make_envs(RunConfig(env=env, env_kwargs=env_kwargs), num_envs)
    envs.reset(seed=3)
    total = 0.0
    for step in range(1000):
        _, reward, terminated, truncated, _ = envs.step(np.full(num_envs, step % 2))
        total += float(reward[0])
        if terminated[0] or truncated[0]:
            break
        ended = np.logical_or(terminated, truncated)
        if ended.any() and envs.metadata["autoreset_mode"] is gym.vector.AutoresetMode.DISABLED:
            envs.reset(options={"reset_mask": ended})
    envs.close()
    return step + 1, total


@pytest.mark.parametrize(
    ("env", "env_kwargs"),
    [
        ("CartPole-v1", {"max_episode_steps": -1}),
        ("CartPole-v1", {"max_episode_steps": 5}),
        ("CartPole-v1", {"max_episode_steps": 5, "disable_env_checker": False, "sutton_barto_reward": True}),
        ("Wrapped-v0", {}),
        ("Silent-v0", {}),
        ("Loose-v0", {}),
        (next(iter(CLASSIC)), {"max_episode_steps": 5}),
        ("MountainCar-v0", {"max_episode_steps": -1, "goal_velocity": 0.01}),
    ],
)
def test_arguments_of_an_environment_mean_the_same_for_one_and_for_many(env: str, env_kwargs: dict[str, Any]) -> None:
    if env in CLASSIC:
        env = "Acrobot-v1"
    single = gym.make(env, **env_kwargs)  # the judge
    single.reset(seed=3)
    total = 0.0
    for step in range(1000):
        _, reward, terminated, truncated, _ = single.step(step % 2)
        total += float(reward)
        if terminated or truncated:
            break
    assert courses(env, env_kwargs, 1) == courses(env, env_kwargs, 3) == (step + 1, total)


@pytest.mark.parametrize("env_kwargs", [{"max_episode_steps": None}, {"disable_env_checker": True}])
def test_arguments_that_say_nothing_change_nothing(env_kwargs: dict[str, Any]) -> None:
    for num_envs in (1, 3):
        assert courses("CartPole-v1", env_kwargs, num_envs) == courses("CartPole-v1", {}, num_envs)


def test_an_environment_that_exists_as_vectors_only_is_made_singly_too() -> None:
    assert courses("Vectors-v0", {}, 1) == courses("Vectors-v0", {}, 2) == (9, 9.0)


@pytest.mark.parametrize("limit", [0, -5, 2.5, True, "five"])
def test_a_limit_that_gymnasium_refuses_is_refused_for_many_too(limit: Any) -> None:
    def outcome(num_envs: int) -> str:
        try:
            return str(courses("CartPole-v1", {"max_episode_steps": limit}, num_envs))
        except ValueError as error:
            return str(error)

    assert outcome(1) == outcome(3)


def test_an_evaluation_is_cut_where_those_in_training_were(tmp_path: Path) -> None:
    config = dataclasses.replace(GRID, env="CartPole-v1", env_kwargs={"max_episode_steps": -1}, layout="linear",
                                 evaluation_max_steps=4)  # fmt: skip
    path = train(config, tmp_path / "run").run_dir
    assert [row["num_cut"] for row in read_metrics(path) if row["kind"] == "evaluation"] == [1, 1]
    assert evaluate_run(path, 5).lengths == (4,) * 5
