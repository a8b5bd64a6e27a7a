"""Runs that are stopped, killed, damaged or disturbed: what goes on is the run that would have been, bit for bit.

Mutants that must die here: a generator, optimiser moment, target copy, trace, priority or replay cursor left out of the
checkpoint · the environments' state left out · rows of metrics written twice · the next evaluation or log forgotten ·
a signal that stops the run without saving · a second writer let in · diverged parameters saved over good ones.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq.apps.cli import main
from neuralq.learners import GradientSettings, OnlineSettings, ReplaySettings, RolloutSettings
from neuralq.q import MLP
from neuralq.runs import Run, RunConfig, resume, train
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.run_folder import RunFolder, RunFolderBusy, read_config, read_metrics
from neuralq.runs.loop import Diverged
from neuralq.runs.stream import EnvironmentFault

GRID = "FrozenLake-v1"  # of finitely many states, and its episodes end
CLOCKS = ("cpu_seconds", "wall_seconds", "steps_per_second")


class Stopped(BaseException):
    """Ends a run in the middle as a kill would: nothing of the library catches it."""


def stop_at(steps: int) -> Any:
    def hook(row: Mapping[str, Any]) -> None:
        if row["kind"] == "train" and row["env_steps"] >= steps:
            raise Stopped

    return hook


def clockless(path: Path) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in read_metrics(path)]


def outcome(run: Run) -> tuple[Any, ...]:
    return run.parameters_sha256, run.env_steps, run.greedy_return


def configuration(**given: Any) -> RunConfig:
    periods = {
        "total_steps": 600,
        "evaluate_every": 200,
        "evaluation_episodes": 2,
        "checkpoint_every": 150,
        "log_every": 50,
    }
    return RunConfig(**{**periods, "env": "CartPole-v1", "body": None, **given})


def rollout(layout: str = "action-output", **settings: Any) -> dict[str, Any]:
    sizes = {"num_envs": 4, "num_steps": 8, "num_epochs": 2, "num_minibatches": 2}
    return {"layout": layout, "rollout": RolloutSettings(**{**sizes, **settings})}


def replay(layout: str = "action-output", **settings: Any) -> dict[str, Any]:
    sizes = {"learning_starts": 100, "batch_size": 16, "capacity": 400, "target_period_updates": 30}
    return {"learner": "replay", "layout": layout, "replay": ReplaySettings(**{**sizes, **settings})}


def online(layout: str, **settings: Any) -> dict[str, Any]:
    return {"learner": "online", "layout": layout, "online": OnlineSettings(**settings)}


SMALL = MLP((16,))
CASES = {
    "rollout, network": rollout() | {"body": SMALL},
    "rollout, watkins, target network": rollout("separate", returns="watkins", target_period_updates=3)
    | {"body": SMALL},
    "rollout, linear, annealed": rollout("linear", anneal=True, optimiser="adam"),
    "rollout, table": rollout("table") | {"env": GRID},
    "replay, one-step": replay() | {"body": MLP((16,), layer_norm=True)},
    "replay, prioritised double n-step": replay(prioritised=True, target_rule="double", num_steps=3, num_envs=2)
    | {"body": SMALL},
    "replay, blocks": replay("action-input", target_rule="watkins", block_length=4, train_period=70) | {"body": SMALL},
    "replay, table": replay("table", optimiser="sgd", learning_rate=0.1) | {"env": GRID},
    "online, linear": online("linear", trace="dutch"),
    "online, network": online("action-output", trace="replacing") | {"body": SMALL, "total_steps": 300},
    "online, table": online("table", step_size=0.1) | {"env": GRID},
    "qrc, network": {"learner": "gradient", "gradient": GradientSettings(step_size=1e-3), "body": SMALL},
    "gq, linear": {
        "learner": "gradient", "layout": "linear", "gradient": GradientSettings(method="gq", lambda_=0.4, beta=0.5),
    },
}  # fmt: skip


SLOW = (
    "rollout, table",
    "rollout, linear, annealed",
    "replay, table",
    "replay, one-step",
    "online, table",
    "gq, linear",
    "qrc, network",
)


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else []) for name in CASES])
def test_a_run_stopped_anywhere_ends_as_if_it_had_not_been(name: str, tmp_path: Path) -> None:
    config = configuration(**CASES[name])
    whole = train(config, tmp_path / "whole")
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", [stop_at(config.total_steps * 2 // 3)])
    saved = checkpoint.load_newest(tmp_path / "parts" / "checkpoints").step
    assert 0 < saved < read_metrics(tmp_path / "parts")[-1]["env_steps"]  # something is really done again
    parts = resume(tmp_path / "parts")
    assert outcome(parts) == outcome(whole)
    assert clockless(tmp_path / "parts") == clockless(tmp_path / "whole")
    with pytest.warns(UserWarning, match="nothing is left to do"):
        assert outcome(resume(tmp_path / "parts")) == outcome(whole), "a finished run stays as it is"


def test_a_run_stopped_before_its_first_checkpoint_starts_again(tmp_path: Path) -> None:
    config = configuration(**CASES["rollout, table"])
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", [stop_at(50)])
    assert not (tmp_path / "parts" / "checkpoints").exists()
    assert outcome(resume(tmp_path / "parts")) == outcome(train(config, tmp_path / "whole"))


def test_a_larger_budget_becomes_the_runs_own(tmp_path: Path) -> None:
    config = configuration(**CASES["rollout, network"])
    train(config, tmp_path / "short")
    with pytest.raises(Stopped):
        resume(tmp_path / "short", total_steps=1200, hooks=[stop_at(900)])
    assert read_config(tmp_path / "short")["total_steps"] == 1200
    longer = train(configuration(**CASES["rollout, network"], total_steps=1200), tmp_path / "long")
    assert resume(tmp_path / "short").parameters_sha256 == longer.parameters_sha256


# Real processes. Importing torch and loading kernels costs seconds, so one process does that and forks the others.

SERVER = """
import json, os, sys
import torch
torch.set_num_threads(1)
from neuralq.apps.cli import main, runs
runs.write_report = lambda path: path
main(json.loads(sys.argv[1]))
print("ready", flush=True)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        order = json.loads(line)
        log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1), os.dup2(log, 2)
        status = main(order["argv"])
        sys.stdout.flush()
        os._exit(status)
    print(pid, flush=True)
    print(os.waitpid(pid, 0)[1], flush=True)
"""


class Processes:
    """Starts the command line in new processes and says how each ended."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "log"
        warm_up = ["train", "CartPole-v1", *KILLED, "--total-steps", "200", "--run-dir", str(folder / "run")]
        program = [sys.executable, "-c", SERVER, json.dumps(warm_up)]
        self.server = subprocess.Popen(program, stdin=-1, stdout=-1, stderr=subprocess.DEVNULL, text=True)
        assert self.server.stdout is not None
        while self.server.stdout.readline() != "ready\n":
            assert self.server.poll() is None

    def start(self, argv: list[str]) -> int:
        assert self.server.stdin is not None and self.server.stdout is not None
        self.server.stdin.write(json.dumps({"argv": argv, "log": str(self.log)}) + "\n")
        self.server.stdin.flush()
        return int(self.server.stdout.readline())

    def status(self) -> int:
        """Exit status of the one that runs, negative if a signal ended it."""
        assert self.server.stdout is not None
        return os.waitstatus_to_exitcode(int(self.server.stdout.readline()))


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    started = Processes(tmp_path_factory.mktemp("processes"))
    yield started
    assert started.server.stdin is not None
    started.server.stdin.close()
    started.server.wait(60)
    assert started.server.stdout is not None
    started.server.stdout.close()


STEPS = 12_000
KILLED = ["--total-steps", str(STEPS), "--rollout.num-envs", "8", "--rollout.num-steps", "16", "--hidden", "32"]
KILLED += ["--evaluate-every", "3000", "--evaluation-episodes", "1", "--preset", "false", "--seed", "5"]


@pytest.fixture(scope="module")
def undisturbed(processes: Processes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("undisturbed") / "run"
    processes.start(["train", "CartPole-v1", *KILLED, "--run-dir", str(path)])
    assert processes.status() == 0
    return path


def refused_at_once(path: Path) -> str:
    """What a second writer is told; asked in this process, where everything is imported already."""
    with pytest.raises(RunFolderBusy) as refused:
        resume(path)
    return str(refused.value)


def wait_for(found: Any, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


def newest(path: Path) -> str:
    return max((p.name for p in path.glob("checkpoints/step-*")), default="")


def summary_of(path: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((path / "summary.json").read_text())
    return {k: v for k, v in loaded.items() if k in ("parameters_sha256", "env_steps", "greedy_return")}


def kill_and_resume(start: Any, status: Any, path: Path, num_kills: int, rng: np.random.Generator) -> int:
    """Starts the run and kills it again and again; returns how many kills left a half-written checkpoint."""
    half_written = 0
    for kill in range(num_kills):
        before = newest(path)
        if kill == 0:
            pid = start(["train", "CartPole-v1", *KILLED, "--checkpoint-every", "100", "--run-dir", str(path)])
            wait_for((path / "run.json").exists)
        else:
            pid = start(["resume", str(path)])
            if kill % 4 != 3:  # every fourth life may also end while it is still preparing
                wait_for(lambda before=before: newest(path) > before)
        time.sleep(0.05 * rng.random())
        os.kill(pid, signal.SIGKILL)
        assert status() == -signal.SIGKILL, "the run ended before it was killed; make it longer"
        half_written += any(path.glob("checkpoints/.tmp-write-*"))
    start(["resume", str(path)])
    assert status() == 0
    return half_written


@pytest.mark.parametrize("kills", [pytest.param(3, marks=pytest.mark.whole), pytest.param(10, marks=pytest.mark.slow)])
def test_a_run_killed_again_and_again_ends_with_the_same_bits(
    kills: int, processes: Processes, undisturbed: Path, tmp_path: Path
) -> None:
    path = tmp_path / "killed"
    half = kill_and_resume(processes.start, processes.status, path, kills, np.random.default_rng(7))
    print(f"{half} of {kills} kills left a half-written checkpoint")
    assert summary_of(path) == summary_of(undisturbed)
    assert clockless(path) == clockless(undisturbed)


@pytest.mark.slow
def test_twelve_processes_of_their_own_killed_in_turn_end_with_the_same_bits(undisturbed: Path, tmp_path: Path) -> None:
    running: list[subprocess.Popen[bytes]] = []

    def start(argv: list[str]) -> int:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        running.append(subprocess.Popen([sys.executable, "-m", "neuralq", *argv], **quiet))  # type: ignore[call-overload]
        return running[-1].pid

    path = tmp_path / "killed"
    kill_and_resume(start, lambda: running[-1].wait(300), path, 12, np.random.default_rng(8))
    assert summary_of(path) == summary_of(undisturbed)
    assert clockless(path) == clockless(undisturbed)


@pytest.mark.whole
@pytest.mark.parametrize(("name", "status"), [("SIGTERM", 143), ("SIGINT", 130)])
def test_a_signal_saves_then_ends_and_a_second_writer_is_refused(
    name: str, status: int, processes: Processes, undisturbed: Path, tmp_path: Path
) -> None:
    path = tmp_path / "signalled"
    pid = processes.start(["train", "CartPole-v1", *KILLED, "--checkpoint-every", "600", "--run-dir", str(path)])
    wait_for(lambda: newest(path))
    message = refused_at_once(path)
    before = newest(path)
    os.kill(pid, signal.Signals[name])
    assert processes.status() == status
    assert f"is being written by process {pid};" in message
    assert newest(path) > before
    told = processes.log.read_text()
    assert f"{name}: saved at" in told and f"neuralq resume {path}" in told
    assert json.loads((path / "summary.json").read_text())["interrupted_by"] == name
    processes.start(["resume", str(path)])
    assert processes.status() == 0
    assert summary_of(path) == summary_of(undisturbed)
    assert clockless(path) == clockless(undisturbed)


def test_the_command_line_tells_a_second_writer_in_one_line(
    trained: tuple[Path, Run], capsys: pytest.CaptureFixture[str]
) -> None:
    path, run = trained
    with RunFolder.open(path):
        assert main(["resume", str(path)]) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and f"{path} is being written by process {os.getpid()}; wait for it" in lines[0]
    with pytest.warns(UserWarning, match="nothing is left to do"):
        assert outcome(resume(path)) == outcome(run)


# Damaged checkpoints, on one run of two checkpoints.


@pytest.fixture
def trained(tmp_path: Path) -> tuple[Path, Run]:
    config = configuration(**CASES["rollout, table"])
    return tmp_path / "run", train(config, tmp_path / "run")


def damage(folder: Path) -> None:
    file = folder / "state.json"
    file.write_bytes(file.read_bytes()[:-3])


def test_a_damaged_newest_checkpoint_costs_only_the_steps_since_the_one_before(
    trained: tuple[Path, Run], capsys: pytest.CaptureFixture[str]
) -> None:
    path, run = trained
    damage(path / "checkpoints" / newest(path))
    with pytest.warns(UserWarning, match=r"damaged: state\.json.*falling back to step"):
        again = resume(path)
    assert outcome(again) == outcome(run)
    damage(path / "checkpoints" / newest(path))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["resume", str(path)]) == 0
    warning, *_ = [line for line in capsys.readouterr().err.splitlines() if "falling back" in line]
    assert warning.startswith("neuralq: warning: ") and "UserWarning" not in warning


def test_no_intact_checkpoint_is_one_clear_error(trained: tuple[Path, Run], capsys: pytest.CaptureFixture[str]) -> None:
    path, _ = trained
    for folder in path.glob("checkpoints/step-*"):
        damage(folder)
    for command in ("resume", "evaluate"):
        assert main([command, str(path)]) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and "no usable checkpoint" in lines[0]


# Environments that misbehave.


class Counter(gym.Env[Any, Any]):
    """Counts to 20; hands out a NaN reward at its 150th step and may hold what nobody can copy."""

    observation_space = spaces.Box(0, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, poisoned: bool = False, opaque: bool = False, scale: float = 1.0) -> None:
        self.poisoned, self.scale, self.steps, self.t = poisoned, scale, 0, 0
        if opaque:
            self.ticks = iter(int, 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self._observation(), {}

    def _observation(self) -> Any:
        return np.array([self.t / 20, self.np_random.random()], np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        self.steps += 1
        reward = np.nan if self.poisoned and self.steps == 150 else float(action) * self.scale
        return self._observation(), reward, self.t >= 20, False, {}


gym.register("test/Counter-v0", Counter)


def test_an_environment_that_cannot_be_copied_resumes_at_an_episode_boundary_and_says_so(tmp_path: Path) -> None:
    for name in ("rollout, network", "replay, prioritised double n-step", "online, linear"):
        config = configuration(**CASES[name] | {"env": "test/Counter-v0", "env_kwargs": {"opaque": True}})
        path = tmp_path / name
        with pytest.raises(Stopped):
            train(config, path, [stop_at(400)])
        run = resume(path)
        assert run.resumability.startswith("resumes at an episode boundary, not bit-exact: ")
        assert "ticks" in run.resumability
        assert run.env_steps >= 600 and [r["env_steps"] for r in clockless(path)] == sorted(
            r["env_steps"] for r in clockless(path)
        )


def test_a_nan_reward_ends_the_run_with_its_place_and_leaves_the_last_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    argv = [
        "train",
        "test/Counter-v0",
        "--env-kwargs",
        '{"poisoned": true}',
        "--run-dir",
        str(path),
        "--preset",
        "false",
    ]
    argv += ["--total-steps", "900", "--checkpoint-every", "64", "--rollout.num-envs", "4", "--rollout.num-steps", "8"]
    assert main([*argv, "--hidden", "8", "--evaluate-every", "5000"]) == 1
    *_, line = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in line and "environment 0, step 10 of its episode, field reward" in line and "nan" in line
    saved = checkpoint.load_newest(path / "checkpoints")
    assert saved.step == 576 and np.isfinite(saved.state["learner"]["descent"]["parameters"].numpy()).all()
    with pytest.raises(EnvironmentFault, match="field reward"):
        resume(path)  # deterministic: it happens again
    assert checkpoint.load_newest(path / "checkpoints").step == 576


@pytest.mark.parametrize("case", ["online, linear", "rollout, network", "replay, one-step"])
def test_divergence_is_told_and_never_saved(case: str, tmp_path: Path) -> None:
    config = configuration(**CASES[case] | {"env": "test/Counter-v0", "checkpoint_every": 64})

    poison: list[Any] = []

    def spoil(row: Mapping[str, Any]) -> None:
        if row["env_steps"] >= 300:
            poison[0].learner.engine.flat.values[:] = torch.nan

    from neuralq.runs import control

    build = control.build_session
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(control, "build_session", lambda config: poison.append(build(config)) or poison[0])
        with pytest.raises(Diverged, match=r"no longer finite.*smaller step size"):
            train(config, tmp_path / "run", [spoil])
    saved = checkpoint.load_newest(tmp_path / "run" / "checkpoints")
    learner = saved.state["learner"]
    assert torch.isfinite(learner.get("parameters", learner.get("descent", {}).get("parameters"))).all()
    assert 0 < saved.step < 400


def test_a_step_size_that_is_too_large_is_an_error_of_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["train", "test/Counter-v0", "--env-kwargs", '{"scale": 1000}', "--learner", "online", "--layout", "linear"]
    argv += ["--online.step-size", "50", "--total-steps", "4000", "--checkpoint-every", "20"]
    assert main([*argv, "--run-dir", str(tmp_path / "run"), "--evaluate-every", "9000"]) == 1
    *_, line = capsys.readouterr().err.strip().splitlines()
    assert "diverged" in line and "smaller step size" in line
