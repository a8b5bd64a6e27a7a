"""An environment is somebody else's code in our process: what it prints in C, its threads, its folder, its memory.

Mutants that die here: a result that shares its line with what a library printed; a command that never ends for a thread
that was left; a film that follows the environment into another folder; the number of threads an environment asked for.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from neuralq.apps.cli import main, terminal
from neuralq.runs import faults
from neuralq.runs.stream import Interaction

NOISY = '''
import os, threading, time
import gymnasium as gym, numpy as np, torch
from gymnasium import spaces

class Noisy(gym.Env):
    """Two steps an episode; prints to descriptor 1, leaves a thread, changes its folder and the number of threads."""
    observation_space, action_space = spaces.Discrete(3), spaces.Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        torch.set_num_threads(3)
        os.chdir("/")
        threading.Thread(target=time.sleep, args=(600,), name="for ever").start()
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        os.write(1, b"no newline")
        return self.s, {}
    def step(self, action):
        self.s += 1
        return self.s, 1.0, self.s == 2, False, {}
    def render(self):
        return np.zeros((20, 20, 3), np.uint8)

gym.register("Noisy-v0", Noisy, disable_env_checker=True)
'''
COMMAND = "import sys; from neuralq.apps.cli import main, terminal; terminal.GRACE = 0.2; sys.exit(main())"


@pytest.mark.slow
def test_what_an_environment_does_to_the_process_stays_out_of_the_result_and_the_command_ends(tmp_path: Path) -> None:
    (tmp_path / "noisy.py").write_text(NOISY)
    root = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (root, root / "envs", tmp_path)))}

    def run(*argv: str) -> tuple[list[str], str]:
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", COMMAND, *argv, "--json"],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=120,
        )  # fmt: skip
        assert time.monotonic() - began < 100 and "for the thread 'for ever'" in done.stderr
        return done.stdout.splitlines(), done.stderr

    few = ("--total-steps", "40", "--rollout.num-envs", "2", "--rollout.num-steps", "10", "--resume-probe", "false")
    (line,), errors = run("train", "noisy:Noisy-v0", "--layout", "table", *few, "--run-dir", "run")
    assert json.loads(line)["env_steps"] == 40 and "no newline" in errors
    (line,), errors = run("record", "run", "--gif", "film.gif")
    assert json.loads(line)["files"] == {"film.gif": (tmp_path / "film.gif").stat().st_size} and "no newline" in errors


def test_the_result_has_a_descriptor_of_its_own_and_gives_it_back(capfd: pytest.CaptureFixture[str]) -> None:
    with capfd.disabled():  # descriptors 1 and 2 as they are, but for what is laid over them here
        kept = os.dup(1), os.dup(2)
        (out, into_out), (err, into_err) = os.pipe(), os.pipe()
        try:
            os.dup2(into_out, 1), os.dup2(into_err, 2)
            sys_stdout, sys.stdout = sys.stdout, open(1, "w", closefd=False)
            try:
                print("before ", end="")
                with terminal.descriptor_of_its_own() as own:
                    os.write(1, b"in C")
                    print("result", file=own)
                print("after", flush=True)
            finally:
                sys.stdout = sys_stdout
        finally:
            os.dup2(kept[0], 1), os.dup2(kept[1], 2)
        assert (os.read(out, 99), os.read(err, 99)) == (b"before result\nafter\n", b"in C")
        for descriptor in (*kept, out, into_out, err, into_err):
            os.close(descriptor)


class Threads(gym.Env[Any, Any]):
    observation_space, action_space = spaces.Discrete(2), spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        return 0, {}

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
        torch.set_num_threads(torch.get_num_threads() + 1)
        return 0, 0.0, False, False, {}


def test_a_step_does_not_change_how_many_threads_learn() -> None:
    before = torch.get_num_threads()
    stream = Interaction(SyncVectorEnv([Threads] * 2, autoreset_mode=AutoresetMode.DISABLED), 0.9, 0)
    for _ in range(2):
        stream.step(lambda s: (torch.zeros(2, dtype=torch.int64), torch.ones(2)))
        assert torch.get_num_threads() == before


def test_memory_that_torch_is_refused_is_said_in_a_line() -> None:
    with pytest.raises(RuntimeError) as refused:
        torch.empty(2**58, dtype=torch.uint8)
    line, where = faults.explained(refused.value) or ["nothing", ""]
    assert "test_processes_of_others.py" in where and line.startswith(
        f"torch was refused {2**58} bytes of memory; take a smaller network, smaller batches"
    )
    on_device = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of")
    assert (faults.explained(on_device) or [""])[0].startswith("torch was refused 2.50 GiB of memory; take")
    assert faults.explained(RuntimeError("a fault of ours")) is None


def test_a_command_called_from_python_ends_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []
    monkeypatch.setattr("neuralq.apps.cli.end_without_waiting", ended.append)
    assert main(["--version"]) == 0 and ended == []
    monkeypatch.setattr(sys, "argv", ["neuralq", "--version"])
    assert main() == 0 and ended == [0]
    assert np.isfinite(terminal.GRACE) and terminal.GRACE >= 1
