"""Kills parts of a Ray cluster again and again while a sweep runs on it, and counts what that has done.

A sweep of short CartPole runs is made by the command ``neuralq sweep --ray`` on a cluster of two nodes of this machine.
Every few seconds a worker of Ray's, a node (its raylet; another is added) or the command (which is begun again) is
killed by SIGKILL, while a run goes on. A node may also be frozen: it is taken for dead and its run begun elsewhere,
while its worker still writes. With --storage none the process beside the command may be killed. Another sweep is begun
until there were enough rounds. Each run has to be finished, once (but where a node was frozen), with the bits that
local processes give, and no process may be left. The exit status is 0 only then.

    python scripts/ray_kills.py --what worker --rounds 20
    python scripts/ray_kills.py --what node --rounds 20 --storage none
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

TOKEN = "NEURALQ_RAY_KILLS"
"""In the environment of every process of the cluster; its value is where the runs write down what they do."""
ASKED = "env: CartPole-v1\ntotal_steps: {steps}\ncheckpoint_every: {every}\nseeds: {seeds}\n"
PATIENCE = 60.0


class Journal:
    """A hook that writes down where a run begins, and how it ends."""

    def __init__(self) -> None:
        self.begun = False

    def on_step(self, session: Any) -> None:
        if not self.begun:
            self.begun = True
            note("zero" if session.env_steps <= 64 else "resumed", session)

    def on_end(self, session: Any) -> None:
        note(f"end-{session.ended_by}", session)


def note(what: str, session: Any) -> None:
    line = f"{what} {session.config.seed} {session.env_steps}\n"
    descriptor = os.open(os.environ[TOKEN], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.write(descriptor, line.encode())
    os.close(descriptor)


def ours() -> dict[int, str]:
    """Processes with the token, and their command lines."""
    found = {}
    for place in Path("/proc").iterdir():
        if place.name.isdigit() and int(place.name) != os.getpid():
            try:
                if f"{TOKEN}={os.environ[TOKEN]}".encode() in (place / "environ").read_bytes().split(b"\0"):
                    found[int(place.name)] = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
    return found


def children() -> list[int]:
    """Processes in which runs go on, and those that they are forked of."""
    return [pid for pid, line in ours().items() if "multiprocessing" in line]


def parent_of(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except (OSError, IndexError):
        return 0


def workers_at_runs() -> list[int]:
    """Workers of Ray's with a run that goes on: it is forked of a process which is the worker's child."""
    found, alive = set(children()), ours()
    forked = [parent for pid in found if (parent := parent_of(pid)) in found]
    return [worker for pid in forked if (worker := parent_of(pid)) in alive]


def num_begun() -> int:
    """How often runs have begun or gone on, by what they write down."""
    journal = Path(os.environ[TOKEN])
    lines = journal.read_text().splitlines() if journal.exists() else []
    return sum(line.startswith(("zero", "resumed")) for line in lines)


class Trial:
    """A cluster, and the sweeps that are made on it."""

    def __init__(self, options: argparse.Namespace, root: Path) -> None:
        from ray.cluster_utils import Cluster

        self.options, self.root, self.random = options, root, random.Random(options.seed)
        self.cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        self.nodes = [self.cluster.add_node(num_cpus=1) for _ in range(2)]
        self.rounds = 0
        self.faults: list[str] = []
        self.counted: Counter[str] = Counter()

    def command(self, folder: Path, *more: str) -> list[str]:
        return [sys.executable, "-m", "neuralq", "sweep", str(self.root / "asked.yaml"), str(folder), *more]

    def start(self, folder: Path) -> subprocess.Popen[bytes]:
        words = ["--ray", self.cluster.address, "--storage", self.options.storage, "--hook", "ray_kills:Journal"]
        log = open(folder.with_suffix(".out"), "ab")
        return subprocess.Popen(self.command(folder, *words), stdout=log, stderr=log)

    def sweep(self, folder: Path, expected: dict[int, str]) -> None:
        """One sweep to its end, with kills while there are rounds left."""
        command, begun, due = self.start(folder), 0, math.inf
        while command.poll() is None:
            time.sleep(0.05)
            if self.rounds == self.options.rounds:
                continue
            if due == math.inf and num_begun() > begun:  # since the last kill a run has begun, or gone on
                due = time.monotonic() + self.random.uniform(0, 4)
            if time.monotonic() > due and workers_at_runs():
                begun, due = num_begun(), math.inf
                self.rounds += 1
                if self.options.what == "coordinator":
                    command.kill()
                    command.wait()
                    self.await_silence("the command was killed")
                    command = self.start(folder)
                else:
                    self.kill()
        self.await_silence("the sweep ended")
        if command.returncode:
            said = folder.with_suffix(".out").read_text(errors="replace").splitlines()[-3:]
            self.faults.append(f"{folder.name}: exit status {command.returncode}, {said}")
        self.check(folder, expected)

    def kill(self) -> None:
        if self.options.what == "worker":
            os.kill(self.random.choice(workers_at_runs()), signal.SIGKILL)
            return
        if self.options.what == "shelf":
            for pid, line in ours().items():
                if line.startswith("ray::Shelf"):
                    os.kill(pid, signal.SIGKILL)
            return
        node = self.nodes.pop(self.random.randrange(2))
        self.cluster.worker_nodes.discard(node)
        if self.options.what == "frozen":
            os.kill(node.all_processes["raylet"][0].process.pid, signal.SIGSTOP)
            self.nodes.append(self.cluster.add_node(num_cpus=1))
            alive = len(self.cluster.global_state._live_node_ids())
            while len(self.cluster.global_state._live_node_ids()) == alive:
                time.sleep(0.1)
            time.sleep(self.random.uniform(0, 6))  # somebody else begins with its run meanwhile
            os.kill(node.all_processes["raylet"][0].process.pid, signal.SIGCONT)
        else:
            node.kill_raylet()
            self.nodes.append(self.cluster.add_node(num_cpus=1))

    def await_silence(self, when: str) -> None:
        began = time.monotonic()
        while left := children():
            if time.monotonic() - began > PATIENCE:
                self.faults.append(f"{PATIENCE:g} s after {when} there are still {[ours().get(pid) for pid in left]}")
                return
            time.sleep(0.2)

    def check(self, folder: Path, expected: dict[int, str]) -> None:
        told = json.loads(subprocess.check_output(self.command(folder, "--status", "--json")).splitlines()[-1])
        for run in told["runs"]:
            self.counted["runs"] += 1
            if run["state"] != "finished":
                self.faults.append(f"{folder.name}, seed {run['seed']}: {run['state']} ({run['reason']})")
            elif run["parameters_sha256"] != expected[run["seed"]]:
                self.faults.append(f"{folder.name}, seed {run['seed']}: other bits")
        journal = Path(os.environ[TOKEN])
        journal.touch()
        noted = Counter(tuple(line.split()[:2]) for line in journal.read_text().splitlines())
        journal.unlink()
        for seed in expected:
            ends = noted["end-budget", str(seed)]
            if ends < 1 or (ends > 1 and self.options.what != "frozen"):
                self.faults.append(f"{folder.name}, seed {seed}: came to its end {ends} times")
        for (what, _), times in noted.items():
            self.counted[what] += times
        left = [p.name for p in folder.iterdir() if "attempts" in p.name or p.name.startswith(".tmp")]
        if left:
            self.faults.append(f"{folder.name}: left over {left}")


def expected_bits(root: Path) -> dict[int, str]:
    words = [sys.executable, "-m", "neuralq", "sweep", str(root / "asked.yaml"), str(root / "local"), "--json"]
    told = json.loads(subprocess.check_output(words, stderr=subprocess.DEVNULL).splitlines()[-1])
    return {run["seed"]: run["parameters_sha256"] for run in told["runs"]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", choices=("worker", "node", "coordinator", "frozen", "shelf"), default="worker")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--storage", choices=("shared", "none"), default="shared")
    parser.add_argument("--runs", type=int, default=8, help="of each sweep")
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ray-kills-") as folder:
        root = Path(folder)
        asked = ASKED.format(steps=options.steps, every=options.steps // 20, seeds=options.runs)
        (root / "asked.yaml").write_text(asked)
        os.environ[TOKEN] = str(root / "journal")
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        if options.what == "frozen":  # a few seconds of silence are enough
            os.environ |= {"RAY_health_check_period_ms": "1000", "RAY_health_check_timeout_ms": "2000"}
            os.environ |= {"RAY_health_check_failure_threshold": "3", "RAY_health_check_initial_delay_ms": "0"}
        os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        expected = expected_bits(root)
        trial, began = Trial(options, root), time.monotonic()
        try:
            number = 0
            while trial.rounds < options.rounds:
                number += 1
                trial.sweep(root / f"sweep-{number}", expected)
        finally:
            trial.cluster.shutdown()
        seconds = time.monotonic() - began
    counted = ", ".join(f"{what} {times}" for what, times in sorted(trial.counted.items()))
    print(f"{trial.rounds} times a {options.what} killed in {number} sweeps, {seconds:.0f} s: {counted}")
    print("\n".join(trial.faults) or "no run lost, none done twice, none differing, no process left")
    return 1 if trial.faults else 0


if __name__ == "__main__":
    sys.exit(main())
