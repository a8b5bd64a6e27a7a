"""The run folder: one writer, honest metrics across a kill, and a new run never on top of an old one.

Mutants that must die here: rows at the checkpoint's own step dropped · a torn line kept or glued to the next row · lock
not given back · lock taken by readers · marker written first · NaN written as NaN · hostname among the versions.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from neuralq.runs.folder import run_folder as record
from neuralq.runs.folder.run_folder import (
    RunFolder,
    RunFolderBusy,
    RunFolderError,
    default_run_path,
    is_run_folder,
    library_versions,
    read_config,
    read_metrics,
    read_seed,
    read_summary,
)

CONFIG = {"env": "CartPole-v1", "lambda_": 0.65, "learning_rate": 1e-05, "hidden": [64, 64], "target": None, "on": True}


def make(path: Path, seed: int = 3) -> RunFolder:
    return RunFolder.create(path, config=CONFIG, seed=seed)


def test_a_new_run_says_what_it_was_told_and_what_it_ran_on(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "run"
    assert not is_run_folder(path)
    with make(path) as run:
        assert run.checkpoints_path == path / "checkpoints"
    assert is_run_folder(path)
    assert read_config(path) == CONFIG and read_seed(path) == 3 and read_metrics(path) == []
    versions = json.loads((path / "versions.json").read_text())
    assert versions["torch"] == torch.__version__ and versions["numpy"] == np.__version__
    assert {"python", "gymnasium", "numba", "neuralq", "platform"} <= versions.keys()


def test_the_stored_config_is_yaml_too_so_that_it_can_be_given_back(tmp_path: Path) -> None:
    make(tmp_path).close()
    found = yaml.safe_load((tmp_path / "config.json").read_text())
    assert {k: v for k, v in found.items() if k != "learning_rate"} == {
        k: v for k, v in CONFIG.items() if k != "learning_rate"
    }
    assert float(found["learning_rate"]) == 1e-05  # YAML 1.1 takes 1e-05 for a word; jsonargparse and float() do not


def test_versions_name_neither_machine_nor_folder() -> None:
    text = json.dumps(library_versions())
    assert platform.node() not in text and "/" not in text and str(Path.cwd()) not in text


def test_a_new_run_is_refused_where_there_is_one_and_the_old_one_is_untouched(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        run.append_metrics({"env_steps": 1})
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(RunFolderError, match=r"already holds a run.*neuralq resume .*another folder"):
        make(tmp_path, seed=4)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    RunFolder.open(tmp_path).close()  # the refusal left no lock behind


@pytest.mark.parametrize("name", ["metrics.jsonl", "summary.json", "checkpoints"])
def test_the_remains_of_a_run_count_as_one(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(RunFolderError, match=f"already holds a run \\({name}\\)"):
        make(tmp_path)


def test_a_creation_cut_short_may_be_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "notes.txt").write_text("a folder may hold other things")
    replace, left = os.replace, [2]

    def dying(source: Path, target: Path) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(os, "replace", dying)
        make(tmp_path)
    assert not is_run_folder(tmp_path)
    make(tmp_path).close()
    assert read_config(tmp_path) == CONFIG


def test_a_second_writer_is_refused_with_folder_and_process_while_readers_are_not(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        run.append_metrics({"env_steps": 1})
        with pytest.raises(RunFolderBusy, match=f"{tmp_path} is being written by process {os.getpid()}"):
            RunFolder.open(tmp_path)
        with pytest.raises(RunFolderBusy):
            make(tmp_path)
        run.append_metrics({"env_steps": 2})  # the refused ones did not disturb the holder
        assert [r["env_steps"] for r in read_metrics(tmp_path)] == [1, 2]
        assert read_config(tmp_path) == CONFIG
    RunFolder.open(tmp_path).close()
    with pytest.raises(RunFolderError, match="closed"):
        run.append_metrics({"env_steps": 3})
    run.close()


@pytest.mark.whole
def test_the_lock_holds_between_processes_and_ends_with_a_kill(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom neuralq.runs.folder.run_folder import RunFolder\n"
        "run = RunFolder.create(sys.argv[1], config={}, seed=0)\nprint('locked', flush=True)\nsys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(RunFolderBusy, match=f"process {process.pid};"):
            RunFolder.open(tmp_path)
        process.kill()
        process.wait()
        RunFolder.open(tmp_path).close()


def test_metrics_are_finite_numbers_or_null(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        run.append_metrics({"env_steps": np.int64(5), "a": np.float32(0.5), "b": torch.tensor(2.0), "c": float("inf")})
        run.append_metrics({"env_steps": 6, "a": float("nan"), "b": None, "phase": "evaluation", "ok": np.bool_(True)})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert lines[0].startswith('{"env_steps": 5, "a": 0.5, "b": 2.0, "c": null, "crc32": "')
    assert lines[1].startswith('{"env_steps": 6, "a": null, "b": null, "phase": "evaluation", "ok": true, "crc32": "')


def test_a_row_that_could_not_be_read_back_is_refused(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        with pytest.raises(ValueError, match="must hold env_steps"):
            run.append_metrics({"loss": 1.0})
        for steps in (1.5, -1, True):
            with pytest.raises(ValueError, match="env_steps must be a whole number"):
                run.append_metrics({"env_steps": steps})
        with pytest.raises(TypeError, match="loss must be a number"):
            run.append_metrics({"env_steps": 1, "loss": object()})  # type: ignore[dict-item]
    assert read_metrics(tmp_path) == []


def test_resuming_drops_the_rows_after_the_checkpoint_and_a_torn_line(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        for steps in (100, 200, 200, 300):
            run.append_metrics({"env_steps": steps, "loss": 0.1 + steps})
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"env_steps": 400, "lo')
    assert [r["env_steps"] for r in read_metrics(tmp_path)] == [100, 200, 200, 300]  # readers pass over it
    with RunFolder.open(tmp_path) as run:
        assert run.truncate_metrics(200) == 1
        assert run.truncate_metrics(200) == 0
        run.append_metrics({"env_steps": 250})
    rows = read_metrics(tmp_path)
    assert [r["env_steps"] for r in rows] == [100, 200, 200, 250] and rows[0]["loss"] == 0.1 + 100
    with RunFolder.open(tmp_path) as run:
        assert run.truncate_metrics(0) == 4 and read_metrics(tmp_path) == []


def test_a_torn_line_is_not_glued_to_the_next_row(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        run.append_metrics({"env_steps": 1})
    for torn in ('{"env_steps"', '{"env_steps": 2}'):  # the second is whole but for its end
        with open(tmp_path / "metrics.jsonl", "a") as file:
            file.write(torn)
        with RunFolder.open(tmp_path) as run:
            run.append_metrics({"env_steps": 7})
    assert [r["env_steps"] for r in read_metrics(tmp_path)] == [1, 7, 7]


def test_truncation_cut_short_leaves_the_old_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def dying(source: Path, target: Path) -> None:
        raise KeyboardInterrupt

    with make(tmp_path) as run:
        for steps in (1, 2):
            run.append_metrics({"env_steps": steps})
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(os, "replace", dying)
            run.truncate_metrics(1)
    assert [r["env_steps"] for r in read_metrics(tmp_path)] == [1, 2]


@pytest.mark.parametrize("line", ["garbage", "[1]", '{"loss": 1}', '{"env_steps": "x"}', "\udcff"])
def test_a_damaged_line_is_named(tmp_path: Path, line: str) -> None:
    make(tmp_path).close()
    text = f'{{"env_steps": 1}}\n{line}\n{{"env_steps": 2}}\n'
    (tmp_path / "metrics.jsonl").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(RunFolderError, match=r"metrics.jsonl, line 2, is no row"):
        read_metrics(tmp_path)


def test_the_summary_is_replaced_whole_and_missing_until_written(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        with pytest.raises(RunFolderError, match=r"no summary yet.*neuralq resume"):
            read_summary(tmp_path)
        run.write_summary({"greedy_return": float("nan"), "env_steps": np.int64(4), "stages": [{"a": 1.5}]})
        run.write_summary({"greedy_return": 500.0})
    assert read_summary(tmp_path) == {"greedy_return": 500.0}
    assert not [p for p in tmp_path.iterdir() if p.name.endswith(".tmp")]


def test_folders_that_are_no_runs_are_refused(tmp_path: Path) -> None:
    for read in (read_config, read_metrics, read_seed, read_summary, RunFolder.open):
        with pytest.raises(RunFolderError, match=r"no neuralq run in .*neuralq train"):
            read(tmp_path)
    marker = tmp_path / "run.json"
    for content, message in (
        ('{"seed": 1}', "not written by neuralq"),
        ("[]", "damaged"),
        ("{", "damaged"),
        ('{"format": "neuralq-run", "version": 9, "seed": 1}', "format version 9.*upgrade"),
    ):
        marker.write_text(content)
        with pytest.raises(RunFolderError, match=message):
            read_seed(tmp_path)
    assert not (tmp_path / "run.lock").exists()


def test_a_config_that_json_cannot_hold_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="use null"):
        RunFolder.create(tmp_path / "a", config={"clip": float("inf")}, seed=0)
    with pytest.raises(TypeError):
        RunFolder.create(tmp_path / "a", config={"env": object()}, seed=0)
    with pytest.raises(ValueError, match="seed must be"):
        RunFolder.create(tmp_path / "a", config={}, seed=-1)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("CartPole-v1", "CartPole-v1-table-s7-20240102-030405"),
        ("ALE/Pong-v5", "ALE-Pong-v5-table-s7-20240102-030405"),
        ("my.games:deep/Ns/X-v0", "my.games-deep-Ns-X-v0-table-s7-20240102-030405"),
        ("../../etc", "etc-table-s7-20240102-030405"),
        ("..", "table-s7-20240102-030405"),
        ("a b\n\0ü", "a-b-table-s7-20240102-030405"),
    ],
)
def test_default_paths_are_one_plain_folder_name(env_id: str, name: str) -> None:
    path = default_run_path(env_id, "table", 7, datetime(2024, 1, 2, 3, 4, 5))
    assert path.parent == Path("runs") and path.name == name
    assert len(default_run_path("x" * 999, "table", 7, datetime(2024, 1, 2)).name) < 160


def test_reading_a_run_loads_no_torch() -> None:
    code = "import sys, neuralq.runs.folder.run_folder; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert record.__all__ == sorted(record.__all__)
