"""Checkpoints when the writer dies: a kill at each call that touches the disk, and real SIGKILLs at random moments.

Mutants that must die here: manifest written before the other files · rename before fsync · folder not synced · the old
checkpoint deleted before the new one stands · left-over temporary folders kept · a replaced step unreadable meanwhile.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.checkpoint import CheckpointError, load_newest, save


class Killed(BaseException):
    """Stands for SIGKILL: from the given system call on, nothing of the process has any effect."""


class Mortal:
    """Counts the calls that change the disk and dies at one of them, half-way through if it writes bytes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, dies_at: int) -> None:
        self.calls, self.dies_at = 0, dies_at
        for name in ("fsync", "rename", "mkdir", "rmdir", "unlink", "replace"):
            monkeypatch.setattr(os, name, self.wrap(getattr(os, name)))
        monkeypatch.setattr(
            checkpoint, "save_file", self.wrap(checkpoint.save_file, lambda t, p: Path(p).write_bytes(b"12"))
        )
        monkeypatch.setattr(np, "save", self.wrap(np.save, lambda file, a, allow_pickle: file.write(b"\x93NUMPY")))
        monkeypatch.setattr(checkpoint, "signed", self.wrap(checkpoint.signed))

    def wrap(self, function: Callable[..., Any], partial: Callable[..., Any] | None = None) -> Callable[..., Any]:
        def mortal(*args: Any, **kwargs: Any) -> Any:
            self.calls += 1
            if self.calls >= self.dies_at:
                if partial is not None and self.calls == self.dies_at:
                    partial(*args, **kwargs)
                raise Killed
            return function(*args, **kwargs)

        return mortal


def deaths(folder: Path, steps: tuple[int, ...], saved: int) -> Iterator[tuple[int, bool]]:
    """Kills the saving of ``saved`` at its first, second, … call, each time on a fresh folder with ``steps`` in it."""
    for dies_at in range(1, 200):
        shutil.rmtree(folder, ignore_errors=True)
        for step in steps:
            save(folder, step, {"old": step})
        with pytest.MonkeyPatch.context() as monkeypatch:
            mortal = Mortal(monkeypatch, dies_at)
            try:
                save(folder, saved, {"new": saved, "t": torch.ones(2), "a": np.ones(2), "b": np.zeros(1 << 17)})
            except Killed:
                pass
        yield dies_at, mortal.calls >= dies_at
        if mortal.calls < dies_at:
            return
    raise AssertionError("it never got through")


@pytest.mark.parametrize("saved", [30, 20], ids=["a new step", "a step again"])
def test_a_kill_at_any_call_leaves_a_whole_checkpoint_and_the_next_save_cleans_up(tmp_path: Path, saved: int) -> None:
    folder, seen = tmp_path / "c", []
    for _, died in deaths(folder, (10, 20), saved):
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # what a kill leaves is never mistaken for a damaged checkpoint
            found = load_newest(folder)
        assert found.state == {"old": 20} or found.state["t"].tolist() == [1, 1]
        assert found.step == (saved if "new" in found.state else 20)
        seen.append((died, "new" in found.state))
        save(folder, 40, {"last": 40})
        left = sorted(p.name for p in folder.iterdir())
        assert len(left) == 2 and left[-1] == "step-000000000040"
        assert load_newest(folder).state == {"last": 40}
    assert seen[0] == (True, False) and seen[-1] == (False, True) and len(seen) > 12


def test_a_full_disk_is_one_clear_error_and_the_last_checkpoint_is_intact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 1, {"old": 1})

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched, pytest.raises(CheckpointError, match=r"No space left.*intact"):
        patched.setattr(os, "fsync", full)
        save(tmp_path, 2, {"new": 2})
    assert load_newest(tmp_path).state == {"old": 1}


WRITER = """
import os, sys, time, numpy as np, torch
from neuralq.runs.folder.checkpoint import save
torch.set_num_threads(1)
for child in range(6):
    if os.fork() == 0:
        step = 1000 * child
        print(os.getpid(), flush=True)
        while True:
            step += 1
            save(sys.argv[1], step, {"step": step, "t": torch.full((5000,), float(step)), "a": np.full(150_000, step)})
    os.wait()
"""


def test_writers_killed_by_sigkill_always_leave_a_whole_checkpoint(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    with subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        steps = []
        for child, line in enumerate(process.stdout):
            time.sleep(0.03 + 0.12 * rng.random())
            if child == 0:  # the first must have got one through
                while not any(tmp_path.glob("step-*")):
                    time.sleep(0.01)
            os.kill(int(line), signal.SIGKILL)
            time.sleep(0.01)
            found = load_newest(tmp_path)
            assert found.state["t"].tolist() == [float(found.step)] * 5000 and (found.state["a"] == found.step).all()
            steps.append(found.step)
    assert len(steps) == 6 and steps == sorted(steps)


def test_everything_is_on_disk_before_the_rename_and_the_rename_before_the_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut may undo whatever was not forced to disk, in any order; no kill of a process shows that."""
    events: list[str] = []
    fsync, rename = os.fsync, os.rename

    def logged_fsync(descriptor: int) -> None:
        fsync(descriptor)
        events.append(Path(f"/dev/fd/{descriptor}").resolve().name)

    def logged_rename(source: Path, target: Path) -> None:
        rename(source, target)
        events.append(f"rename to {Path(target).name}")

    monkeypatch.setattr(os, "fsync", logged_fsync)
    monkeypatch.setattr(os, "rename", logged_rename)
    save(tmp_path, 1, {"t": torch.ones(1), "a": np.ones(1), "b": np.zeros(1 << 17)})
    *files, manifest, temporary, renamed, parent = events
    assert sorted(files) == ["array-00000.npy", "arrays.npy", "state.json", "tensors.safetensors"]
    assert manifest == "manifest.json" and temporary.startswith(".tmp-write-step-000000000001")
    assert renamed == "rename to step-000000000001" and parent == tmp_path.name


def test_a_small_state_costs_little_beside_the_fsyncs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    state = {"flat": torch.zeros(20_000), "trace": np.zeros(2_000), "counters": dict.fromkeys(map(str, range(50)), 1)}
    seconds = []
    for step in range(20):
        start = time.process_time()
        save(tmp_path, step, state)
        seconds.append(time.process_time() - start)
    assert np.median(seconds) < 0.010
