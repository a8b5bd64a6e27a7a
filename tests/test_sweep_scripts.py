"""The files for schedulers of others, read and executed without one; `test_sweep_slurm` hands them to a real Slurm."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from neuralq.apps.cli import main
from neuralq.runs.sweep.scripts import kubernetes_job, num_shares, slurm_script


def stub(path: Path, text: str) -> Path:
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose name has to be quoted, an ``scontrol`` that notes what it is asked, and a stand-in for Python."""
    folder = tmp_path / "it's a $(date) sweep %j"
    folder.mkdir()
    stub(tmp_path / "scontrol", f'echo "$@" >>{tmp_path}/asked')
    monkeypatch.setattr(
        sys, "executable", str(stub(tmp_path / "python 3", f'printf "%s\\n" "$@" >{tmp_path}/words\n. {tmp_path}/job'))
    )
    return folder


def perform(place: Path, job: str, told: int = 0, restarts: int = 0, seconds: int = 0) -> tuple[int, str]:
    """The script's exit status and what it asked of ``scontrol``, where the command does ``job``."""
    root = place.parent
    (root / "job").write_text(job)
    (root / "script").write_text(slurm_script(place, 24))
    env = {**os.environ, "PATH": f"{root}:{os.environ['PATH']}", "SLURM_ARRAY_JOB_ID": "12", "SLURM_ARRAY_TASK_ID": "3"}
    env |= {"SLURM_JOB_ID": "12", "SLURM_RESTART_COUNT": str(restarts), "SECONDS": str(seconds)}
    with subprocess.Popen(["bash", str(root / "script")], env=env, stdout=subprocess.PIPE) as process:
        for _ in range(told):
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
            process.send_signal(signal.SIGUSR1)
        status = process.wait(20)
    asked = root / "asked"
    return status, asked.read_text() if asked.exists() else ""


SAVES = "trap 'exit {}' USR1; echo ready; for _ in {{1..2000}}; do sleep .01; done"


TWICE = "n=0; trap 'n=$((n + 1)); echo ready; [ $n = 2 ] && exit 75' USR1; " + SAVES.partition("; ")[2]


@pytest.mark.parametrize(
    ("job", "told", "status", "asked"),
    [
        ("exit 0", 0, 0, ""),
        ("exit 1", 0, 1, ""),
        ("exit 75", 0, 75, "requeue 12_3\n"),
        (SAVES.format(75), 1, 75, "requeue 12_3\n"),
        (SAVES.format(0), 1, 0, ""),  # finished just then
        (SAVES.format(1), 1, 1, ""),
        ("echo ready; exec sleep 20", 1, 138, "requeue 12_3\n"),  # it did not listen yet
        (TWICE, 2, 75, "requeue 12_3\n"),
        ("kill -USR1 $$", 0, 138, ""),
        ("kill -KILL $$", 0, 137, ""),
    ],
)
def test_a_task_queues_again_when_work_is_left_and_only_then(
    place: Path, job: str, told: int, status: int, asked: str
) -> None:
    assert perform(place, job, told) == (status, asked)


def test_a_task_without_time_to_work_does_not_queue_for_ever(place: Path) -> None:
    assert perform(place, "exit 75", restarts=2) == (75, "requeue 12_3\n")
    (place.parent / "asked").unlink()
    assert perform(place, "exit 75", restarts=3) == (75, "")
    assert perform(place, "exit 75", restarts=3, seconds=30) == (75, "requeue 12_3\n")  # where bash begins to count
    (place.parent / "asked").unlink()
    (place.parent / "scontrol").unlink()
    assert perform(place, "exit 75") == (75, "")  # where there is no scontrol


def test_the_script_is_sound_and_its_words_arrive_whole(place: Path) -> None:
    perform(place, "exit 0")
    words = (place.parent / "words").read_text().splitlines()
    assert words == ["-m", "neuralq", "sweep", str(place), "--index", "3", "--of", "24", "--workers", "1"]
    script = place.parent / "script"
    subprocess.run(["bash", "-n", str(script)], check=True)
    if shutil.which("shellcheck"):
        checked = subprocess.run(["shellcheck", "--exclude=SC2016", str(script)], capture_output=True, text=True)
        assert checked.returncode == 0, checked.stdout
    lines = script.read_text().splitlines()
    asked = dict(line[8:].partition("=")[::2] for line in lines if line.startswith("#SBATCH "))
    assert asked["--array"] == "0-23" and asked["--signal"] == "B:USR1@120"
    assert asked["--output"] == f'"{str(place).replace("%", "%%")}/slurm-%A_%a.log"'
    with pytest.raises(ValueError, match="rename the folder"):
        slurm_script('/data/a "sweep"', 24)
    assert "--gpus-per-task=2" in slurm_script("/data", 1, num_gpus=2) and "OMP_NUM_THREADS=4" in slurm_script(
        "/data", 1, 4
    )


def test_runs_are_dealt_to_as_many_tasks_as_a_site_takes() -> None:
    assert [num_shares(runs) for runs in (1, 1000, 1001)] == [1, 1000, 1000]
    with pytest.raises(ValueError, match="at most the number of runs, which is 3, got 4"):
        num_shares(3, 4)


def job_of(path: str | Path = "/data/a $(OMP_NUM_THREADS) $$weep") -> dict[str, Any]:
    return dict(yaml.safe_load(kubernetes_job(path, 3, "registry/neuralq:1", num_threads=2, num_gpus=1)))


def test_a_job_of_kubernetes_tells_what_is_lost_from_what_failed() -> None:
    spec = job_of()["spec"]
    assert (spec["completionMode"], spec["completions"], spec["parallelism"]) == ("Indexed", 3, 3)
    rules = {
        str(rule.get("onExitCodes", rule.get("onPodConditions"))): rule["action"]
        for rule in spec["podFailurePolicy"]["rules"]
    }
    assert rules == {
        "[{'type': 'DisruptionTarget', 'status': 'True'}]": "Ignore",
        "{'operator': 'In', 'values': [75]}": "Ignore",
        "{'operator': 'In', 'values': [1, 2]}": "FailIndex",
    }
    pod = spec["template"]["spec"]
    assert pod["restartPolicy"] == "Never" and pod["terminationGracePeriodSeconds"] == 120
    [container], [volume] = pod["containers"], pod["volumes"]
    assert volume["persistentVolumeClaim"]["claimName"] == "neuralq-sweeps"
    assert container["resources"]["limits"] == {"memory": "2Gi", "nvidia.com/gpu": "1"}
    # As the kubelet has it (kubernetes/third_party/forked/golang/expansion): "$(X)" is X where it knows X, "$$" is "$".
    known = {"JOB_COMPLETION_INDEX": "2", **{pair["name"]: pair["value"] for pair in container["env"]}}
    words = [
        re.sub(r"\$\$|\$\((\w+)\)", lambda m: known.get(m[1], m[0]) if m[1] else "$", w) for w in container["args"]
    ]
    folder = "/sweeps/a $(OMP_NUM_THREADS) $$weep"
    assert words == ["sweep", folder, "--index", "2", "--of", "3", "--workers", "1"]
    with pytest.raises(ValueError, match="--image"):
        kubernetes_job("/data", 3, " ")


def test_a_job_is_what_the_schema_of_kubernetes_says() -> None:
    validate = pytest.importorskip(
        "kubernetes_validate", reason="kubernetes-validate, 23 MB of schemas, is not installed"
    )
    for version in ("1.31", "1.37"):
        assert validate.validate(job_of(), version, strict=True) == version
    with pytest.raises(validate.ValidationError):
        validate.validate(job_of() | {"spec": {"completionmode": "Indexed"}}, "1.31", strict=True)


ASKED = "{env: CartPole-v1, total_steps: 500, evaluation_episodes: 2, learning_rate: [1e-3, 1e-2], seeds: 2}"


def test_the_command_prints_what_a_scheduler_is_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "asked.yaml").write_text(ASKED)
    words = ["sweep", str(tmp_path / "asked.yaml"), str(tmp_path / "there")]
    assert main([*words, "--slurm-script"]) == 0
    assert "#SBATCH --array=0-3\n" in capsys.readouterr().out
    assert main([*words[:1], words[2], "--slurm-script", "--of", "2"]) == 0
    assert "--of 2 --workers 1\n" in capsys.readouterr().out
    wrong = (["--slurm-script", "--of", "5"], ["--kubernetes-job"], ["--image", "x"], ["--index", "0", "--of", "0"])
    for options in wrong:
        assert main([*words, *options]) in (1, 2)
        assert capsys.readouterr().err.count("\n") == 1
    assert main([*words[:2], words[1], "--slurm-script"]) == 1
    assert "is a file, and no folder for runs" in capsys.readouterr().err
    assert main([*words, "--kubernetes-job", "--image", "registry/neuralq:1", "--claim", "mine"]) == 0
    job = yaml.safe_load(capsys.readouterr().out)
    assert job["spec"]["completions"] == 4
    assert job["spec"]["template"]["spec"]["volumes"][0]["persistentVolumeClaim"] == {"claimName": "mine"}


@pytest.mark.slow
def test_what_the_pods_of_a_job_do_is_the_whole_sweep(tmp_path: Path) -> None:
    """Each index's command line, where the claim would be."""
    (tmp_path / "asked.yaml").write_text(ASKED)
    begin = [sys.executable, "-m", "neuralq"]
    words = ["sweep", "asked.yaml", "there", "--kubernetes-job", "--image", "x", "--of", "3"]
    printed = subprocess.run([*begin, *words], cwd=tmp_path, capture_output=True, check=True)
    [container] = yaml.safe_load(printed.stdout)["spec"]["template"]["spec"]["containers"]
    assert container["command"] == ["neuralq"]
    for index in range(3):
        args = [word.replace("$(JOB_COMPLETION_INDEX)", str(index)) for word in container["args"]]
        args = [word.replace("/sweeps", str(tmp_path)) for word in args]
        subprocess.run([*begin, *args], check=True, capture_output=True)
        states = subprocess.run([*begin, "sweep", "there", "--status", "--json"], cwd=tmp_path, capture_output=True)
        counts = json.loads(states.stdout.splitlines()[-1])["counts"]
        assert counts.get("finished", 0) == (2, 3, 4)[index]
