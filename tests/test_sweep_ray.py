"""Runs on a Ray cluster of this machine end with the bits of a process of their own, whatever is killed meanwhile.

Mutants that must die here: a folder that is not sent home · a failure that is not told, or stops the others · a node
that does not see the folder and begins all the same · a worker that is lost with its run · a request to end that does
not reach the child · a command that waits for a head that is gone.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import neuralq
from neuralq.apps.cli import main
from neuralq.runs.folder.run_folder import read_summary
from neuralq.runs.sweep import Asked, Engine, LocalProcesses, Sweep, ask, run_sweep
from neuralq.runs.sweep.ray_cluster import RayCluster
from neuralq.runs.sweep.states import saved_steps, state_of

ROOT = Path(__file__).resolve().parents[1]
BASE = {"env": "CartPole-v1", "total_steps": 1000, "checkpoint_every": 250, "evaluate_every": 1000}


def a_sweep(path: Path, *seeds: int, **options: Any) -> Sweep:
    return ask(path, Asked({**BASE, **options}, {}, seeds))


def test_without_ray_the_way_to_install_it_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    sweep = a_sweep(tmp_path / "s", 0)
    assert main(["sweep", str(sweep.path), "--ray", "auto"]) == 1
    assert capsys.readouterr().err.strip().endswith("need the package ray: pip install 'neuralq[ray]'")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head that makes no runs, and a node for one at a time."""
    pytest.importorskip("ray", reason="the extra ray is not installed")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        found: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        found.add_node(num_cpus=1)
        yield found
        found.shutdown()


def alone(path: Path, seed: int) -> str:
    """Of the same run in this process."""
    found: str = neuralq.train(**BASE, seed=seed, run_dir=path).parameters_sha256
    return found


@pytest.mark.whole
@pytest.mark.filterwarnings("ignore")  # Ray's own
@pytest.mark.parametrize("storage", ["shared", "none"])
def test_runs_end_with_the_bits_of_a_process_of_their_own_and_one_that_fails_leaves_the_others(
    tmp_path: Path, cluster: Any, storage: str
) -> None:
    others = {name: value for name, value in BASE.items() if name != "env"}
    sweep = ask(tmp_path / "s", Asked(others, {"env": ["CartPole-v1", "no_such_package:Game-v0"]}, (0, 1)))
    result = run_sweep(sweep, RayCluster(cluster.address, sweep.path, storage=storage), retry_failed=False)
    by_name = {(run.options["env"], run.seed): run for run in result.runs}
    for seed in (0, 1):
        run = by_name["CartPole-v1", seed]
        assert run.summary["parameters_sha256"] == alone(tmp_path / f"alone-{seed}", seed)
        assert read_summary(run.run_dir)["run_dir"] == str(run.run_dir)
        failed = by_name["no_such_package:Game-v0", seed]
        assert failed.state == "failed" and "no_such_package" in failed.reason and "\n" not in failed.reason
    assert [str(p) for p in sweep.path.rglob("*") if "attempts" in p.name or p.name.startswith(".tmp")] == []


@pytest.mark.whole
@pytest.mark.filterwarnings("ignore")
def test_a_node_that_does_not_see_the_folder_says_so_and_one_that_is_asked_to_end_saves(
    tmp_path: Path, cluster: Any
) -> None:
    sweep = a_sweep(tmp_path / "s", 0, total_steps=10_000_000)
    engine = RayCluster(cluster.address, sweep.path)
    try:
        (task,) = (sweep.task(member) for member in sweep.members())
        (sweep.path / "sweep.json").rename(tmp_path / "kept")
        engine.start(task)
        (ended,) = collected(engine)
        assert "does not see" in ended.reason and "--storage none" in ended.reason
        (tmp_path / "kept").rename(sweep.path / "sweep.json")
        engine.start(task)
        until(lambda: saved_steps(sweep.path / "seed-0.attempts" / "1") > 0)
        assert state_of(task.path).state == "running"
        engine.stop()
        (ended,) = collected(engine)
        assert ended.reason == "" and state_of(task.path).state == "stopped" and saved_steps(task.path) > 250
        assert engine.running() == []
    finally:
        engine.close()


def collected(engine: RayCluster) -> list[Any]:
    for _ in range(600):
        if found := engine.collect(0.1):
            return found
    raise AssertionError("nothing has ended")


def until(holds: Any, seconds: float = 90.0) -> None:
    began = time.monotonic()
    while not holds():
        assert time.monotonic() - began < seconds
        time.sleep(0.05)


@pytest.mark.whole
def test_what_is_no_cluster_is_said_at_once(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra ray is not installed")
    for address, told in (("127.0.0.1:9", "nothing answers"), ("ray://x:10001", "ray start --address")):
        with pytest.raises(ConnectionError, match=re.escape(told)):
            RayCluster(address, tmp_path)
    with pytest.raises(ValueError, match="storage must be one of 'shared', 'none'"):
        RayCluster("auto", tmp_path, storage="s3")
    with pytest.raises(ValueError, match="gpus must be a finite number"):
        RayCluster("auto", tmp_path, num_gpus=-1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_24_runs_end_with_the_same_bits_here_and_on_two_nodes(tmp_path: Path, cluster: Any) -> None:
    asked = Asked({"env": "CartPole-v1", "total_steps": 5000}, {"learning_rate": [3e-4, 1e-3, 3e-3]}, tuple(range(8)))
    second, found = cluster.add_node(num_cpus=1), list[list[str]]()
    try:
        for kind in ("local", "shared", "none"):
            sweep = ask(tmp_path / kind, asked)
            config = sweep.configuration(next(sweep.members()))
            engine: Engine = LocalProcesses(2, config)
            if kind != "local":
                engine = RayCluster(cluster.address, sweep.path, storage=kind)
            found.append([run.summary["parameters_sha256"] for run in run_sweep(sweep, engine).runs])
    finally:
        cluster.remove_node(second)
    assert found[0] == found[1] == found[2] and len(set(found[0])) == 24


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("storage", ["shared", "none"])
def test_a_node_without_neuralq_is_one_line(tmp_path: Path, storage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="the extra ray is not installed")
    monkeypatch.chdir(tmp_path)  # workers look into the folder of the command, too
    from ray.cluster_utils import Cluster

    (tmp_path / "lacks" / "neuralq").mkdir(parents=True)
    lacks = "raise ModuleNotFoundError(\"No module named 'neuralq'\")\n"
    (tmp_path / "lacks" / "neuralq" / "__init__.py").write_text(lacks)
    found: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        found.add_node(num_cpus=1, env_vars={"PYTHONPATH": str(tmp_path / "lacks")})
        sweep = a_sweep(tmp_path / "s", 0)
        (run,) = run_sweep(sweep, RayCluster(found.address, sweep.path, storage=storage)).runs
        assert re.fullmatch(r"node [\d.]+ has no neuralq: install there what is .*, 3 times over", run.reason)
    finally:
        found.shutdown()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_command_whose_cluster_loses_its_head_ends_with_one_line(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra ray is not installed")
    from ray.cluster_utils import Cluster

    found: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    found.add_node(num_cpus=1)
    sweep = a_sweep(tmp_path / "s", 0, total_steps=10_000_000)
    words = [sys.executable, "-m", "neuralq", "sweep", str(sweep.path), "--ray", found.address]
    command = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        until(lambda: saved_steps(sweep.path / "seed-0.attempts" / "1") > 0)
        found.head_node.all_processes["gcs_server"][0].process.send_signal(signal.SIGKILL)
        _, said = command.communicate(timeout=90)
        assert said.splitlines()[-1].endswith(
            f"the head of the cluster at {found.address} is gone; run the command again"
        )
    finally:
        command.kill()
        found.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["shared", "none"])
@pytest.mark.parametrize("what", ["worker", "node", "coordinator"])
def test_whatever_is_killed_no_run_is_lost_done_twice_or_different(what: str, storage: str) -> None:
    pytest.importorskip("ray", reason="the extra ray is not installed")
    words = ["--what", what, "--storage", storage, "--rounds", "3", "--runs", "4"]
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "ray_kills.py"), *words], capture_output=True, text=True, timeout=900,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
