"""Processes of our own import nothing from the present folder that the standard library or a package has."""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from neuralq.apps.cli import main
from neuralq.runs.children import python_command, safe_path

PLANTED = "queue secrets selectors json argparse".split()


@pytest.fixture
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present folder, with modules named like the standard library's that leave a file where they are run."""
    folder = tmp_path / "beside"
    folder.mkdir()
    for name in PLANTED:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})\n")
    (folder / "my_own.py").write_text("VALUE = 7\n")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path, str(folder)])  # as the command line does
    return tmp_path / "ran"


def test_a_child_finds_the_standard_library_first_and_the_users_modules_last(beside: Path) -> None:
    code = f"import {', '.join(PLANTED)}, my_own, sys; print(my_own.VALUE, sys.argv[1:])"
    done = subprocess.run([*python_command(code), "a b"], capture_output=True, text=True, check=True)
    assert done.stdout == "7 ['a b']\n" and not beside.exists()


def test_a_child_runs_this_library_where_it_was_found_by_no_search_path(beside: Path) -> None:
    code = "import neuralq, neuralq_envs; print(neuralq.__file__, neuralq_envs.__file__)"
    without = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(python_command(code), capture_output=True, text=True, check=True, env=without)
    import neuralq
    import neuralq_envs

    assert done.stdout.split() == [neuralq.__file__, neuralq_envs.__file__]


def test_the_workers_of_multiprocessing_begin_without_the_present_folder(beside: Path) -> None:
    with safe_path():
        process = multiprocessing.get_context("spawn").Process(target=os.getpid)
        process.start()
    process.join()
    assert process.exitcode == 0 and not beside.exists()
    assert "PYTHONSAFEPATH" not in os.environ


def test_the_module_run_as_a_program_looks_into_the_present_folder_last(beside: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "neuralq", "--version"], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.startswith("neuralq ") and not beside.exists()


@pytest.mark.slow
def test_a_sweep_beside_planted_modules_trains_every_seed(
    beside: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--total-steps", "64", "--evaluation-episodes", "1", "--rollout.num-envs", "2", "--rollout.num-steps", "8"]
    assert main(["train", "CartPole-v1", *given, "--seeds", "2", "--run-dir", str(tmp_path / "s"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_finished"] == 2 and not beside.exists()
