"""Attempts at a run that do not wait for each other: whoever ends first becomes the run, and nothing is lost.

Mutants that must die here: a number taken twice · a checkpoint that is damaged, or not the newest, begun from · rows of
metrics that do not reach the checkpoint · a finished run that is replaced · an attempt that is left over · a run that
is moved away while somebody writes it · a summary that names the attempt's folder · a parcel that leads elsewhere.
"""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest

from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.files import RunFolderBusy
from neuralq.runs.folder.run_folder import RunFolder, read_metrics, read_summary
from neuralq.runs.sweep import attempts
from neuralq.runs.sweep.attempts import begin, pack, publish, take_over, unpack
from neuralq.runs.sweep.states import attempts_path, note_failure, numbered, saved_steps, state_of

TOTAL = 100


def advance(path: Path, *steps: int, end: bool = False) -> None:
    """Goes on with the run in a folder up to each of these steps, as a child does."""
    there = (path / "run.json").exists()
    with RunFolder.open(path) if there else RunFolder.create(path, config={"total_steps": TOTAL}, seed=0) as run:
        run.truncate_metrics(saved_steps(path))
        for step in steps:
            run.append_metrics({"env_steps": step})
            checkpoint.save(run.checkpoints_path, step, {"values": np.full(3, step)})
            checkpoint.save(path / "best", step, {"env_steps": step}, keep=1)
        if end:
            run.write_summary({"env_steps": TOTAL, "run_dir": str(path), "interrupted_by": None})


def begun(path: Path) -> Path:
    found = begin(path, TOTAL)
    assert found is not None
    return found


def rows(path: Path) -> list[int]:
    return [row["env_steps"] for row in read_metrics(path)]


def test_an_attempt_begins_from_the_newest_whole_checkpoint_of_all_before_it(tmp_path: Path) -> None:
    path = tmp_path / "seed-0"
    first = begun(path)
    assert first == attempts_path(path) / "1" and not any(first.iterdir())
    assert state_of(path).state == "not begun"
    advance(first, 10, 20, 30)
    assert state_of(path).state == "stopped"
    with RunFolder.open(first):
        assert state_of(path).state == "running"
    second = begun(path)  # the first is given up, and goes on all the same
    assert (second.name, saved_steps(second), rows(second)) == ("2", 30, [10, 20, 30])
    assert np.array_equal(checkpoint.load_newest(second / "checkpoints").state["values"], np.full(3, 30))
    assert checkpoint.load_newest(second / "best").step == 30
    advance(second, 40)
    advance(first, 40, 50)
    third = begun(path)
    assert (third.name, saved_steps(third)) == ("3", 50), "the older attempt was faster"
    assert numbered(attempts_path(path)) == [third, first], "what holds nothing more is gone"
    next((third / "checkpoints" / "step-000000000050").glob("*.npy")).write_bytes(b"spoilt")
    next((first / "checkpoints" / "step-000000000050").glob("*.npy")).write_bytes(b"spoilt")
    fourth = begun(path)
    assert [p.name for p in (fourth / "checkpoints").iterdir()] == ["step-000000000040"]
    assert not (fourth / "run.lock").exists()


def test_a_number_is_nobody_elses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "seed-0"
    first = begun(path)
    monkeypatch.setattr(attempts, "numbered", lambda folder: [])  # it was made after this one looked
    assert begun(path) != first


def test_who_ends_first_becomes_the_run_and_the_other_is_thrown_away(tmp_path: Path) -> None:
    path = tmp_path / "cell" / "seed-0"
    first = begun(path)
    advance(first, 50)
    second = begun(path)
    second.with_name("2.log").write_text("said")
    advance(second, TOTAL, end=True)
    publish(second, path, TOTAL)
    kept = path.stat().st_ino
    assert read_summary(path)["run_dir"] == str(path) and path.with_name("seed-0.log").read_text() == "said"
    assert not attempts_path(path).exists()
    first.mkdir(parents=True)  # as a writer does that was taken for dead
    advance(first, TOTAL, end=True)
    publish(first, path, TOTAL)
    assert path.stat().st_ino == kept and not attempts_path(path).exists()
    assert begin(path, TOTAL) is None and not attempts_path(path).exists()
    larger = begin(path, 2 * TOTAL)
    assert larger is not None and saved_steps(larger) == TOTAL


def test_an_attempt_whose_worker_died_before_it_told_is_the_run(tmp_path: Path) -> None:
    path = tmp_path / "seed-0"
    advance(begun(path), TOTAL, end=True)
    assert begin(path, TOTAL) is None and state_of(path, TOTAL).state == "finished"
    assert not attempts_path(path).exists()


def test_what_stands_unfinished_in_the_runs_place_is_gone_on_with_unless_somebody_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "seed-0"
    advance(path, 10)
    with RunFolder.open(path), pytest.raises(RunFolderBusy, match="is being written by process"):
        begin(path, TOTAL)
    note_failure(path, "the disk was full")
    own = begun(path)
    assert saved_steps(own) == 10 and rows(own) == [10] and not path.exists()
    note_failure(path, "by one that was taken for dead")
    advance(own, TOTAL, end=True)
    publish(own, path, TOTAL)
    assert state_of(path, TOTAL).state == "finished" and [p.name for p in tmp_path.iterdir()] == ["seed-0"]


def test_an_attempt_that_failed_is_where_the_state_is_read(tmp_path: Path) -> None:
    path = tmp_path / "seed-0"
    own = begun(path)
    advance(own, 10)
    note_failure(own, "no such environment")
    publish(own, path, TOTAL)
    assert state_of(path, TOTAL).reason == "no such environment" and saved_steps(path) == 10


def test_attempts_are_gone_on_with_on_this_machine(tmp_path: Path) -> None:
    path = tmp_path / "seed-0"
    advance(begun(path), 10, 20)
    begun(path)
    take_over(path, TOTAL)
    assert saved_steps(path) == 20 and rows(path) == [10, 20] and not attempts_path(path).exists()


def test_a_copy_is_whole_though_its_source_is_pruned_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "seed-0"
    first = begun(path)
    advance(first, 10, 20)
    copy, copied = shutil.copyfile, list[str]()

    def slow(source: Path, target: Path) -> None:
        copied.append(source.name)
        if len(copied) == 2:  # while its checkpoint is copied, the writer saves two more, and drops this one
            advance(first, 30, 40)
        copy(source, target)

    monkeypatch.setattr(shutil, "copyfile", slow)
    own = begun(path)
    assert saved_steps(own) == 40 and rows(own)[:4] == [10, 20, 30, 40]


def test_a_parcel_comes_home_whole_and_leads_nowhere_else(tmp_path: Path) -> None:
    path = tmp_path / "there" / "run"
    advance(path, 10, 20, end=True)
    path.with_name("run.log").write_text("said")
    parcel = pack(path)
    assert parcel is not None
    unpack(parcel, tmp_path / "home")
    home = tmp_path / "home" / "run"
    assert saved_steps(home) == 20 and rows(home) == [10, 20] and read_summary(home)["env_steps"] == TOTAL
    assert len(list((home / "checkpoints").iterdir())) == 1, "the newest alone travels"
    assert (tmp_path / "home" / "run.log").read_text() == "said"
    forged = io.BytesIO()
    with tarfile.open(fileobj=forged, mode="w") as out:
        out.addfile(tarfile.TarInfo("../outside"))
    with pytest.raises(tarfile.OutsideDestinationError):
        unpack(forged.getvalue(), tmp_path / "home")
    assert not (tmp_path / "outside").exists()
    assert json.loads((path / "summary.json").read_text())["run_dir"] == str(path)
