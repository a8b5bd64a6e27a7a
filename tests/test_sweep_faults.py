"""What breaks under a sweep: its processes, its disk, its folders, a package that is not there; nothing is lost.

`scripts/kill_rounds.py` does the first with as many kills as are wanted.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]

CART = """
import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
gymnasium.register("Cart-v0", CartPoleEnv, max_episode_steps=100)
"""


def neuralq(*words: object, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    env = dict(os.environ, OMP_NUM_THREADS="1")
    if path is not None:
        env["PYTHONPATH"] = f"{env['PYTHONPATH']}{os.pathsep}{path}"
    return subprocess.run([sys.executable, "-m", "neuralq", *map(str, words)], env=env, capture_output=True, text=True)


def ask_for(folder: Path, **options: Any) -> Path:
    asked = {"env": "CartPole-v1", "total_steps": 400, "evaluation_episodes": 2, **options}
    (folder / "asked.yaml").write_text(json.dumps(asked))
    return folder / "asked.yaml"


def states(folder: Path) -> dict[str, tuple[str, str, str]]:
    printed = neuralq("sweep", folder, "--status", "--json").stdout
    runs = json.loads(printed.splitlines()[-1])["runs"]
    names = {run["run_dir"]: str(Path(run["run_dir"]).relative_to(folder)) for run in runs}
    return {names[run["run_dir"]]: (run["state"], run["reason"] or "", run["parameters_sha256"] or "") for run in runs}


@contextlib.contextmanager
def small_disk(path: Path, size: str) -> Iterator[None]:
    path.mkdir(parents=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(path)]
    if os.geteuid() != 0 or shutil.which("mount") is None or subprocess.run(words, capture_output=True).returncode:
        pytest.skip("a small disk cannot be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", str(path)], check=True)


@pytest.mark.slow
def test_a_full_disk_and_a_missing_package_are_their_runs_own(tmp_path: Path) -> None:
    asked = ask_for(tmp_path, env=["CartPole-v1", "cart_of_mine:Cart-v0"], seeds=2)
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "cart_of_mine.py").write_text(CART)
    neuralq("sweep", asked, tmp_path / "sweep", "--slurm-script")
    full = next(name for name in states(tmp_path / "sweep") if name.startswith("env=CartPole") and "seed-1" in name)
    with small_disk(tmp_path / "sweep" / full, "32k"):
        ended = neuralq("sweep", tmp_path / "sweep")
        assert ended.returncode == 1 and ended.stderr.splitlines()[-1].startswith("neuralq: 3 of 4 runs failed")
        found = states(tmp_path / "sweep")
    assert found[full][0] == "failed" and "No space left on device" in found[full][1]
    missing = [reason for name, (state, reason, _) in found.items() if "cart_of_mine" in name and state == "failed"]
    assert len(missing) == 2 and all("No module named 'cart_of_mine'" in reason for reason in missing)
    way_out = ended.stderr.splitlines()[-1].partition("try again with: neuralq ")[2].split()
    assert neuralq(*way_out, path=tmp_path / "package").returncode == 0
    found = states(tmp_path / "sweep")
    assert {state for state, _, _ in found.values()} == {"finished"}
    neuralq("sweep", asked, tmp_path / "undisturbed", path=tmp_path / "package")
    assert found == states(tmp_path / "undisturbed")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the script finds processes in /proc")
@pytest.mark.parametrize("victim", ["worker", "coordinator"])
def test_killed_processes_lose_nothing(victim: str) -> None:
    words = [sys.executable, str(ROOT / "scripts" / "kill_rounds.py"), "--rounds", "3", "--victim", victim]
    ended = subprocess.run(words, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert ended.stdout.splitlines()[-1] == f"3 kills of a {victim}, 0 sweeps with a fault"


@pytest.mark.slow
def test_a_folder_that_is_lost_is_its_runs_own(tmp_path: Path) -> None:
    asked = ask_for(tmp_path, total_steps=20_000, checkpoint_every=1000, learning_rate=[1e-3, 3e-3], seeds=1)
    neuralq("sweep", asked, tmp_path / "undisturbed")
    words = [sys.executable, "-m", "neuralq", "sweep", str(asked), str(tmp_path / "sweep"), "--workers", "2"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not (found := list((tmp_path / "sweep").glob("*/seed-0/checkpoints/step-*"))):
            assert process.poll() is None
            time.sleep(0.01)
        shutil.rmtree(found[0].parents[1], ignore_errors=True)
        _, said = process.communicate(timeout=300)
    ended = states(tmp_path / "sweep")
    assert process.returncode == 0 or "neuralq: 1 of 2 runs failed" in said
    assert sum(state == "finished" for state, _, _ in ended.values()) >= 1
    assert neuralq("sweep", tmp_path / "sweep", "--retry-failed").returncode == 0
    assert states(tmp_path / "sweep") == states(tmp_path / "undisturbed")


@pytest.mark.slow
def test_shares_and_the_whole_at_once_do_each_run_once(tmp_path: Path) -> None:
    """As from several machines: two shares, one of them twice, and somebody who asks for all."""
    asked = ask_for(tmp_path, total_steps=4000, learning_rate=[1e-3, 3e-3], seeds=2)
    neuralq("sweep", asked, tmp_path / "undisturbed")
    begin = [sys.executable, "-m", "neuralq", "sweep", str(asked), str(tmp_path / "sweep")]
    shares = (["--index", "0", "--of", "2"], ["--index", "1", "--of", "2"], ["--index", "1", "--of", "2"], [])
    processes = [subprocess.Popen([*begin, *share], stdout=subprocess.DEVNULL) for share in shares]
    assert [process.wait(600) for process in processes] == [0, 0, 0, 0]
    assert states(tmp_path / "sweep") == states(tmp_path / "undisturbed")
    rows = [
        [json.loads(line)["env_steps"] for line in file.read_text().splitlines() if '"train"' in line]
        for file in (tmp_path / "sweep").glob("*/*/metrics.jsonl")
    ]
    assert len(rows) == 4 and all(steps == sorted(set(steps)) for steps in rows)
