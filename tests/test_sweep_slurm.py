"""A real Slurm of one node, begun by the test, does a sweep by the script that neuralq prints.

It needs Debian's slurm-wlm (slurmctld, slurmd), munge and root, and is skipped with the reason where it cannot start.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
AuthType=auth/munge
AuthInfo=socket={root}/munge.socket,cred_expire=5
StateSaveLocation={root}/state
SlurmdSpoolDir={root}/spool
SlurmctldPidFile={root}/slurmctld.pid
SlurmdPidFile={root}/slurmd.pid
MailProg=/bin/true
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
KillWait=10
SchedulerParameters=sched_interval=1,bf_interval=1
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


class Slurm:
    """The three programs of a cluster of one node, in a folder."""

    def __init__(self, root: Path) -> None:
        self.root, self.host = root, socket.gethostname().partition(".")[0]
        with contextlib.ExitStack() as stack:  # both held until both are known
            sockets = [stack.enter_context(socket.socket()) for _ in range(2)]
            for each in sockets:
                each.bind(("127.0.0.1", 0))
            ports = [each.getsockname()[1] for each in sockets]
        (root / "slurm.conf").write_text(CONFIGURATION.format(root=root, host=self.host, ports=ports))
        (root / "munge.key").write_bytes(os.urandom(128))
        (root / "munge.key").chmod(0o600)
        for name in ("state", "spool"):
            (root / name).mkdir()
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def env(self) -> dict[str, str]:
        return {**os.environ, "SLURM_CONF": str(self.root / "slurm.conf"), "OMP_NUM_THREADS": "1"}

    def start(self, name: str, *words: str) -> None:
        with open(self.root / f"{name}.log", "ab") as log:
            self.processes[name] = subprocess.Popen(
                [name, *words], env=self.env, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def start_all(self) -> None:
        files = {"key-file": "munge.key", "socket": "munge.socket", "pid-file": "munged.pid", "seed-file": "munge.seed"}
        options = [f"--{option}={self.root / name}" for option, name in files.items()]
        self.start("munged", "--foreground", "--force", *options)
        until((self.root / "munge.socket").exists, 10)
        self.start("slurmctld", "-D", "-i")
        self.start("slurmd", "-D", "-N", self.host)
        until(lambda: self.ask("sinfo", "--noheader", "--format=%T").strip() == "idle", 30)

    def ask(self, *words: str, fails: bool = True) -> str:
        answer = subprocess.run(words, env=self.env, capture_output=True, text=True, timeout=60)
        assert fails or answer.returncode == 0, f"{words}: {answer.stderr}"
        return answer.stdout

    def submit(self, script: str, *options: str) -> str:
        answer = subprocess.run(
            ["sbatch", "--parsable", *options], input=script, env=self.env, capture_output=True, text=True
        )
        assert answer.returncode == 0, answer.stderr
        return answer.stdout.strip()

    def states(self, job: str) -> dict[str, str]:
        """The state of each task of an array, by its index."""
        lines = self.ask("squeue", "--array", "--states=all", "--noheader", f"--jobs={job}", "--format=%K %T").split(
            "\n"
        )
        return {index: state for index, _, state in (line.strip().partition(" ") for line in lines if line)}

    def wait(self, job: str, seconds: float) -> dict[str, str]:
        over = {"COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL"}
        until(lambda: set(self.states(job).values()) <= over, seconds)
        return self.states(job)

    def stop(self) -> None:
        self.ask("scancel", "--user=root")
        for process in reversed(self.processes.values()):
            process.terminate()
        for process in self.processes.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()
            process.wait()


def until(holds: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds} seconds")
        time.sleep(0.2)


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        pytest.skip(f"no Slurm here: {', '.join(missing)} missing" if missing else "a Slurm of one's own takes root")
    cluster = Slurm(tmp_path_factory.mktemp("slurm"))
    try:
        cluster.start_all()
    except (OSError, TimeoutError) as error:
        logs = {path.name: path.read_text()[-500:] for path in cluster.root.glob("*.log")}
        cluster.stop()
        pytest.skip(f"Slurm does not start here: {error}: {logs}")
    yield cluster
    cluster.stop()


def neuralq(*words: object) -> str:
    ended = subprocess.run(
        [sys.executable, "-m", "neuralq", *map(str, words)], capture_output=True, text=True, env=os.environ
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def bits(folder: Path) -> dict[tuple[str, int], str]:
    """SHA-256 of the parameters of each run; every run has finished."""
    runs = json.loads(neuralq("sweep", folder, "--status", "--json").splitlines()[-1])["runs"]
    assert {run["state"] for run in runs} == {"finished"}
    return {(json.dumps(run["options"]), run["seed"]): run["parameters_sha256"] for run in runs}


def ask_for(folder: Path, **options: Any) -> Path:
    asked = {"env": "CartPole-v1", "learning_rate": 1e-3, **options}
    (folder / "asked.yaml").write_text(json.dumps(asked))
    return folder / "asked.yaml"


def test_the_printed_script_gives_the_bits_of_local_processes(slurm: Slurm, tmp_path: Path) -> None:
    asked = ask_for(tmp_path, total_steps=5000, learning_rate=[3e-4, 1e-3, 3e-3], seeds=8)
    neuralq("sweep", asked, tmp_path / "here", "--workers", 2)
    script = neuralq("sweep", asked, tmp_path / "a folder", "--slurm-script")
    states = slurm.wait(slurm.submit(script, "--time=10"), 600)
    assert len(states) == 24 and set(states.values()) == {"COMPLETED"}
    assert bits(tmp_path / "a folder") == bits(tmp_path / "here") and len(bits(tmp_path / "here")) == 24
    assert len(list((tmp_path / "a folder").glob("slurm-*_*.log"))) == 24


SLOW = """
import time
import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

class SlowCart(CartPoleEnv):
    def step(self, action):
        time.sleep(.004)
        return super().step(action)

gymnasium.register("SlowCart-v0", SlowCart, max_episode_steps=500)
"""


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[tuple[str, int], str]]]:
    """A sweep of two runs of two minutes, most of it slept through, and what they end with."""
    folder = tmp_path_factory.mktemp("long")
    (folder / "slow_cart.py").write_text(SLOW)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{os.environ['PYTHONPATH']}{os.pathsep}{folder}")
        asked = ask_for(
            folder, env="slow_cart:SlowCart-v0", total_steps=30_000, checkpoint_every=2000, seeds=2,
            evaluate_every=30_000, evaluation_episodes=1, resume_probe=False, threads=1,
        )  # fmt: skip
        neuralq("sweep", asked, folder / "here")
        yield asked, bits(folder / "here")


def test_a_task_whose_time_is_up_saves_and_queues_again(
    slurm: Slurm, tmp_path: Path, long: tuple[Path, dict[tuple[str, int], str]]
) -> None:
    script = neuralq("sweep", long[0], tmp_path / "sweep", "--slurm-script")
    job = slurm.submit(script, "--time=2", "--signal=B:USR1@20")
    states = slurm.wait(job, 900)
    assert set(states.values()) == {"COMPLETED"}
    assert bits(tmp_path / "sweep") == long[1]
    logs = [path.read_text() for path in (tmp_path / "sweep").glob("slurm-*_*.log")]
    assert len(logs) == 2 and all("SIGUSR1: go on with" in log for log in logs)  # appended to
    assert not any("DUE TO TIME LIMIT" in log for log in logs)


def test_handing_in_the_script_again_is_the_whole_of_recovery(
    slurm: Slurm, tmp_path: Path, long: tuple[Path, dict[tuple[str, int], str]]
) -> None:
    """One task is cancelled, the processes of the other are killed."""
    sweep = tmp_path / "sweep"
    script = neuralq("sweep", long[0], sweep, "--slurm-script")
    job = slurm.submit(script, "--time=30")
    until(lambda: len(list(sweep.glob("*/checkpoints/step-*"))) >= 2, 120)
    slurm.ask("scancel", f"{job}_0", fails=False)
    for process in processes_of("--index 1 --of 2"):
        os.kill(process, signal.SIGKILL)
    assert slurm.wait(job, 60) == {"0": "CANCELLED", "1": "FAILED"}
    until(lambda: not processes_of(str(sweep)), 150)  # what was forked saves and ends with its parent
    again = slurm.submit(script, "--time=30")
    assert set(slurm.wait(again, 600).values()) == {"COMPLETED"}
    assert bits(sweep) == long[1]


def processes_of(words: str) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if words in path.read_bytes().replace(b"\0", b" ").decode(errors="replace") and "python" in str(
                path.read_bytes()
            ):
                found.append(int(path.parent.name))
    return found
