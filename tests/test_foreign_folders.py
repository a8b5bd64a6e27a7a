"""Run folders that somebody else made or a disk has changed: nothing elsewhere is touched, no wrong value believed.

Mutants that must die here: a link followed when writing, a hard link emptied, a pipe waited for, a temporary name that
can be foreseen, a changed digit shown, a lost row not missed, nesting without a bound, a folder outside the sweep
written to, a stranger's module imported.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from neuralq.apps.cli import main
from neuralq.learners import RolloutSettings
from neuralq.runs import RunConfig, load, resume, train
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.files import FolderLock, RunFolderError, read_json, read_rows, replacing, row_line
from neuralq.runs.folder.run_folder import RunFolder, read_config, read_metrics, read_seed, read_summary
from neuralq.runs.hooks import WeightsAndBiases
from neuralq.runs.report.page import Page
from neuralq.runs.sweep import LocalProcesses, create_sweep, open_sweep, run_sweep
from neuralq.runs.trust import refuse_strangers

PRECIOUS = "what must not be touched\n"


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing a report takes longer than all the rest, and is not what is asked here."""
    monkeypatch.setattr("neuralq.apps.cli.runs.write_report", lambda path: path)


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    path = tmp_path / "elsewhere" / "precious"
    path.parent.mkdir()
    path.write_text(PRECIOUS)
    return path


def a_run(path: Path, num_rows: int = 3) -> Path:
    with RunFolder.create(path, config={"env": "CartPole-v1"}, seed=3) as folder:
        for step in range(num_rows):
            folder.append_metrics({"kind": "evaluation", "env_steps": 100 * step, "greedy_return": 17.25 + step})
        folder.write_summary({"env_steps": 300, "greedy_return": 19.25})
    return path


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rollout = RolloutSettings(num_envs=2, num_steps=16)
    config = RunConfig(total_steps=64, evaluate_every=64, evaluation_episodes=1, log_every=32, rollout=rollout)
    return train(config, tmp_path_factory.mktemp("short") / "run").run_dir


def placed(kind: str, at: Path, target: Path) -> None:
    at.unlink(missing_ok=True)
    (os.symlink if kind == "symbolic" else os.link)(target, at)


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
def test_a_link_in_place_of_the_lock_leaves_what_it_leads_to_whole(kind: str, tmp_path: Path, precious: Path) -> None:
    path = a_run(tmp_path / "run")
    placed(kind, path / "run.lock", precious)
    with pytest.raises(RunFolderError, match=r"run\.lock is a (link|second name)"):
        RunFolder.open(path)
    placed(kind, tmp_path / "sweep.lock", precious)
    with pytest.raises(RunFolderError, match=r"sweep\.lock is a (link|second name)"):
        FolderLock(tmp_path / "sweep.lock", "busy")
    assert precious.read_text() == PRECIOUS


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
def test_no_row_is_appended_and_no_line_cut_through_a_link(kind: str, tmp_path: Path, precious: Path) -> None:
    path = a_run(tmp_path / "run")
    precious.write_text(torn := '{"env_steps": 1}\nhalf a line')
    with RunFolder.open(path) as folder:
        placed(kind, path / "metrics.jsonl", precious)
        with pytest.raises(RunFolderError, match=r"metrics\.jsonl is a"):
            folder.append_metrics({"env_steps": 7})
    with pytest.raises(RunFolderError, match=r"metrics\.jsonl is a"):
        RunFolder.open(path)
    assert precious.read_text() == torn


def test_replaced_files_go_through_no_link_and_their_temporary_names_cannot_be_foreseen(
    tmp_path: Path, precious: Path
) -> None:
    precious.write_text(written := '{"env": "CartPole-v1"}\n')
    path = a_run(tmp_path / "run")
    for name in (".config.json.tmp", ".summary.json.tmp", ".report.html.partial", ".partial-weights.safetensors"):
        os.symlink(precious, path / name)
    for name in ("config.json", "summary.json", "report.html"):
        placed("symbolic", path / name, precious)
    with RunFolder.open(path) as folder:
        folder.replace_config({"env": "other"})
        folder.write_summary({"env_steps": 1})
    Page("a title").write(path / "report.html")
    assert precious.read_text() == written
    assert read_config(path) == {"env": "other"} and read_summary(path) == {"env_steps": 1}
    names = set()
    for _ in range(2):
        with replacing(path / "page") as temporary:
            names.add(temporary.name)
    assert len(names) == 2  # drawn anew each time


def test_a_failed_replacement_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "page").write_text("old")
    with pytest.raises(OSError, match="full"), replacing(tmp_path / "page") as temporary:
        temporary.write_text("half")
        raise OSError("the disk is full")
    assert (tmp_path / "page").read_text() == "old" and os.listdir(tmp_path) == ["page"]


def test_checkpoints_are_neither_written_nor_deleted_behind_a_link(tmp_path: Path, short: Path) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    shutil.copytree(short, run)
    shutil.move(run / "checkpoints", elsewhere)
    os.symlink(elsewhere, run / "checkpoints")
    before = sorted(p.name for p in elsewhere.iterdir())
    with pytest.raises(RunFolderError, match="checkpoints is a link"):
        resume(run, total_steps=128)
    assert sorted(p.name for p in elsewhere.iterdir()) == before


def test_a_checkpoint_that_is_a_link_is_let_go_of_and_what_it_leads_to_stays(tmp_path: Path) -> None:
    state = {"x": torch.ones(2)}
    theirs = checkpoint.save(tmp_path / "theirs", 1, state)
    ours = tmp_path / "ours"
    ours.mkdir()
    os.symlink(theirs, ours / theirs.name)
    for step in (2, 3, 4):
        checkpoint.save(ours, step, state)
    assert checkpoint.load(theirs).step == 1 and not (ours / theirs.name).is_symlink()


def test_the_log_and_the_folder_of_a_seed_are_no_links(tmp_path: Path, precious: Path) -> None:
    sweep = create_sweep(tmp_path / "sweep", {"env": "CartPole-v1", "total_steps": 10}, [0, 1])
    os.symlink(precious, sweep.path / "seed-0.log")
    os.symlink(precious.parent, sweep.run_path(1))
    result = run_sweep(sweep, LocalProcesses(1))
    assert [run.state for run in result.runs] == ["failed", "failed"]
    assert "seed-0.log is a link" in result.runs[0].reason and "seed-1 is a link" in result.runs[1].reason
    assert precious.read_text() == PRECIOUS and os.listdir(precious.parent) == ["precious"]


def test_the_record_of_weights_and_biases_is_begun_behind_no_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys
    import types

    def refused(**_: object) -> None:
        raise RuntimeError("no login")

    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=refused))
    (tmp_path / "wandb").mkdir()
    os.symlink(tmp_path / "planted", tmp_path / "wandb" / "neuralq-run-id")  # leads nowhere yet
    with pytest.raises(ValueError, match="cannot keep a record"):
        WeightsAndBiases(tmp_path, {})
    assert not (tmp_path / "planted").exists()


@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl", "summary.json", "run.lock"])
def test_a_pipe_in_place_of_a_file_is_refused_and_not_waited_for(name: str, tmp_path: Path) -> None:
    path = a_run(tmp_path / "run")
    (path / name).unlink()
    os.mkfifo(path / name)
    read: dict[str, Any] = {"config.json": read_config, "metrics.jsonl": read_metrics, "summary.json": read_summary}
    with pytest.raises(RunFolderError, match=f"{name} is a pipe"):
        read.get(name, RunFolder.open)(path)


@pytest.mark.parametrize("name", ["manifest.json", "state.json", "tensors.safetensors"])
def test_a_pipe_in_a_checkpoint_is_refused_and_not_waited_for(name: str, short: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(short, tmp_path / "run"))
    for path in (run / "checkpoints").iterdir():
        (path / name).unlink()
        os.mkfifo(path / name)
    with pytest.raises(checkpoint.CheckpointError, match=f"{name} is a pipe"):
        load(run)


def test_every_changed_bit_of_rows_and_summary_is_noticed(tmp_path: Path) -> None:
    path = a_run(tmp_path / "run")
    rows, summary, seed = read_metrics(path), read_summary(path), read_seed(path)
    rng = random.Random(0)
    files: tuple[tuple[str, Any, Any], ...] = (
        ("metrics.jsonl", read_metrics, rows), ("summary.json", read_summary, summary), ("run.json", read_seed, seed),
    )  # fmt: skip
    for name, read, right in files:
        written = (path / name).read_bytes()
        for at in rng.sample(range(8 * len(written)), 100):
            changed = bytearray(written)
            changed[at // 8] ^= 1 << at % 8
            (path / name).write_bytes(changed)
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                try:
                    found: Any = read(path)
                except RunFolderError:
                    continue
            if name == "metrics.jsonl":  # the end of a line that looks torn is passed over, and missed
                found = [{k: v for k, v in row.items() if k in rows[0]} for row in found]
                assert found == right or (found == right[: len(found)] and "has lost rows" in str(said[0].message))
            elif name == "summary.json":
                assert {k: v for k, v in found.items() if k in summary} == summary
            else:
                assert found == seed
        (path / name).write_bytes(written)


def test_rows_of_the_former_format_are_read_and_a_missing_checksum_after_others_is_damage(tmp_path: Path) -> None:
    file = tmp_path / "metrics.jsonl"
    old, new = '{"env_steps": 1}\n', row_line({"env_steps": 2}) + "\n"
    file.write_text(old + new)
    assert read_rows(file) == [{"env_steps": 1}, {"env_steps": 2}]
    file.write_text(new + old)
    with pytest.raises(RunFolderError, match=r"line 2, is no row of metrics .its checksum is missing"):
        read_rows(file)


def test_lost_rows_are_missed_by_whoever_reads_and_by_the_run_that_goes_on(tmp_path: Path, short: Path) -> None:
    path = a_run(tmp_path / "run")
    (path / "metrics.jsonl").write_text("")
    with pytest.warns(UserWarning, match="has lost rows: it held 3, and 0 are left"):
        assert read_metrics(path) == []
    copy = tmp_path / "copy"
    shutil.copytree(short, copy)
    (copy / "metrics.jsonl").write_text("")
    (copy / "summary.json").unlink()
    with pytest.warns(UserWarning, match="has lost rows"):
        resume(copy, total_steps=256)


@pytest.mark.parametrize("name", ["config.json", "run.json", "summary.json", "metrics.jsonl"])
@pytest.mark.parametrize("depth", [100, 100_000])
def test_deeply_nested_json_is_damage_in_any_file(name: str, depth: int, tmp_path: Path) -> None:
    path = a_run(tmp_path / "run")
    nested = '{"env_steps": 0, "a": ' + "[" * depth + "]" * depth + "}\n"
    (path / name).write_text(nested + nested if name == "metrics.jsonl" else nested)
    read: dict[str, Any] = {"config.json": read_config, "run.json": read_seed, "summary.json": read_summary}
    with pytest.raises(RunFolderError, match="nested deeper than 64 levels"):
        read.get(name, read_metrics)(path)


def test_a_full_disk_leaves_neither_half_a_row_nor_a_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = a_run(tmp_path / "run")
    before = (path / "metrics.jsonl").read_bytes()
    write = os.write

    def full(descriptor: int, data: bytes) -> int:
        if len(data) < 20:
            raise OSError(28, "No space left on device")
        return write(descriptor, bytes(data[: len(data) // 2]))

    with RunFolder.open(path) as folder, monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space left"):
            folder.append_metrics({"env_steps": 400})
    assert (path / "metrics.jsonl").read_bytes() == before

    def refused(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "_sync", refused)
        with pytest.raises(checkpoint.CheckpointError, match="make room, then resume"):
            checkpoint.save(path / "checkpoints", 5, {"x": torch.ones(2)})
    assert list((path / "checkpoints").iterdir()) == []


def test_what_a_killed_writer_left_is_cleared_by_the_next_one(tmp_path: Path) -> None:
    path = a_run(tmp_path / "run")
    (path / ".tmp-0123456789abcdef-summary.json").write_text("{")
    (path / ".tmp-0123456789abcdef-mine").write_text("mine")
    RunFolder.open(path).close()
    assert [p.name for p in path.iterdir() if p.name.startswith(".tmp")] == [".tmp-0123456789abcdef-mine"]
    assert json.loads((path / "summary.json").read_bytes())["num_rows"] == 3 and "crc32" not in read_json(
        path / "summary.json"
    )


# Sweeps


@pytest.fixture
def sweep_of_others(tmp_path: Path) -> Path:
    config = {"env": "CartPole-v1", "total_steps": 100, "threads": 1}
    return create_sweep(tmp_path / "sweep", config, [0, 1], ["--tensorboard", "--hook", "my_hooks:Log"]).path


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seeds": ["0/../../x"]}, "seed must be a whole number, got '0/../../x'"),
        ({"seeds": [0.5]}, "seed must be a whole number, got 0.5"),
        ({"seeds": [True]}, "seed must be a whole number of at least 0, got True"),
        ({"seeds": [-1]}, "seed must be a whole number of at least 0, got -1"),
        ({"seeds": [10**400]}, "seed must be a whole number below 2^128, got one of 1,329 bits"),  # 400 log2(10)
        ({"seeds": []}, "a sweep needs one seed or more"),
        ({"seeds": {"0": 1}}, "a sweep needs one seed or more"),
        ({"options": ["--run-dir", "/elsewhere"]}, "its options hold '--run-dir'"),
        ({"options": ["--hook", "a:b", "--run-dir=/x"]}, "its options hold '--run-dir=/x'"),
        ({"options": ["--hook", "a:b", "--hook", "--json"]}, "its options hold '--hook'"),
        ({"options": ["--hook"]}, "its options hold '--hook'"),
        ({"options": ["--hook", "--config=x:y"]}, "its options hold '--hook'"),
        ({"options": "--tensorboard"}, "its options must be a list"),
        ({"options": [5]}, "its options hold 5"),
        ({"version": "newest"}, "cannot be read"),
    ],
)
def test_a_sweep_names_whole_numbers_and_its_own_options_or_is_refused(
    changes: dict[str, Any], told: str, sweep_of_others: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert open_sweep(sweep_of_others).options == ("--tensorboard", "--hook", "my_hooks:Log")
    file = sweep_of_others / "sweep.json"
    file.write_text(json.dumps(read_json(file) | changes))
    for command in ("resume", "evaluate", "compare"):
        assert main([command, str(sweep_of_others)]) == 1
        assert told in (error := capsys.readouterr().err) and error.count("\n") == 1
    assert sorted(p.name for p in sweep_of_others.parent.iterdir()) == ["sweep"]


@pytest.mark.parametrize("content", ["5", "{}", '{"total_steps": "many"}', '{"total_steps": 5, "threads": "x"}', "["])
def test_the_configuration_of_a_sweep_is_one_or_is_refused(
    content: str, sweep_of_others: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (sweep_of_others / "config.json").write_text(content)
    assert main(["resume", str(sweep_of_others)]) == 1
    assert (error := capsys.readouterr().err).startswith("neuralq: error: the sweep in") and error.count("\n") == 1


def test_a_changed_bit_of_a_sweep_is_noticed(sweep_of_others: Path) -> None:
    file = sweep_of_others / "sweep.json"
    written, right = file.read_bytes(), open_sweep(sweep_of_others)
    for at in random.Random(2).sample(range(8 * len(written)), 120):
        changed = bytearray(written)
        changed[at // 8] ^= 1 << at % 8
        file.write_bytes(changed)
        try:
            found = open_sweep(sweep_of_others)
        except RunFolderError:
            continue
        assert (found.seeds, found.options) == (right.seeds, right.options)


# Configurations


@pytest.mark.parametrize(
    "changes",
    [
        {"learner": "replay"}, {"learner": "replay", "rollout": None}, {"learner": ["x"]}, {"rollout": {1: 2}},
        {"rollout": [1]}, {"seed": 10**400}, {"total_steps": 10**400}, {"gamma": 10**400}, {"stop_at_return": 10**400},
        {"threads": 10**9}, {"body": {"class": ["MLP"]}}, {"env": 5}, {"env_kwargs": [1]},
        {"env_kwargs": {"no": 1}}, {"kind": ["x"]}, {"kind": "control"}, {"device": "\x00"}, {"engine": [1]},
        {"rollout": {"num_envs": 10**12}}, {"rollout": {"num_steps": 2**70}},
    ],
)  # fmt: skip
def test_an_absurd_configuration_is_one_error_in_every_command(
    changes: dict[str, Any], short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(short, tmp_path / "run"))
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | changes))
    for command in (["resume", str(run), "--total-steps", "96"], ["evaluate", str(run), "--episodes", "1"]):
        status = main(command)
        error = capsys.readouterr().err
        assert "Traceback" not in error
        if status != 0:  # evaluating asks for less than training does
            assert status in (1, 2) and error.startswith("neuralq: ") and error.count("\n") == 1
        else:
            assert command[0] == "evaluate"


@pytest.mark.parametrize("number", ["9" * 400, "9" * 5000, "-" + "9" * 400])
@pytest.mark.parametrize("option", ["--seed", "--total-steps", "--gamma", "--rollout.num-steps", "--seeds"])
def test_a_number_of_hundreds_of_digits_is_wrong_usage(
    option: str, number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "CartPole-v1", f"{option}={number}"]) == 2
    assert option[2:].replace("-", "_").split("_")[0] in capsys.readouterr().err.replace("-", "_")


def test_a_run_whose_folder_is_not_named_in_utf_8_goes_on_and_is_read(short: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(short, tmp_path / os.fsdecode(b"r\xff")))
    assert resume(path, total_steps=256).env_steps >= 256
    assert load(path).predict([0.0, 0.0, 0.0, 0.0]) in (0, 1)


# Hooks


class Broken:
    """A hook that raises where it is told to."""

    where: str = ""

    def __init__(self) -> None:
        if self.where == "made":
            raise LookupError("not made")

    def __call__(self, row: Any) -> None:
        if self.where == "called" and row["env_steps"] >= 32:
            raise LookupError("lost the row")

    def close(self) -> None:
        raise LookupError("not closed")


@pytest.mark.parametrize("where", ["made", "called", "closed"])
def test_a_hook_that_raises_is_told_with_its_line_and_costs_no_training(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Broken, "where", where)
    path = str(tmp_path / "run")
    argv = ["train", "CartPole-v1", "--preset", "false", "--total-steps", "64", "--evaluation-episodes", "1"]
    argv += ["--rollout.num-steps", "8", "--rollout.num-envs", "2", "--log-every", "16", "--resume-probe", "false"]
    status = main([*argv, "--hook", f"{__name__}:Broken", "--run-dir", path])
    error = capsys.readouterr().err
    assert "Traceback" not in error and "LookupError" in error
    if where == "made":
        assert status == 1 and "cannot make the hook" in error and not Path(path).exists()
    elif where == "closed":
        assert status == 0 and "when it was closed: not closed" in error
    else:
        assert status == 1 and f"the hook Broken raised LookupError: lost the row ({__file__}, line " in error
        assert re.search(r"the run is saved at \d+ env steps", error)
        way_out = error[error.index("neuralq resume") :].split()[1:]
        assert main([*way_out, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["env_steps"] >= 64


# Trust


@pytest.mark.parametrize("part", ["env", "body", "hook"])
def test_without_trust_no_module_is_imported_that_is_no_installed_package(
    part: str, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "planted.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    config = json.loads((short / "config.json").read_text())
    for module in ("planted", "no_such_module", "os"):
        named = {"env": {"env": f"{module}:My-v0"}, "body": {"body": {"class": "Custom", "module": f"{module}:Net"}}}
        if part == "hook":
            with pytest.raises(ValueError, match=rf"imports the module {module} \(its hook\)"):
                refuse_strangers(config, f"{module}:Hook")
            continue
        run = Path(shutil.copytree(short, tmp_path / module))
        (run / "config.json").write_text(json.dumps(config | named[part]))
        for command in (["resume"], ["evaluate"], ["watch"], ["record", "--gif", "x.gif"], ["export", "--onnx", "x"]):
            assert main([command[0], str(run), *command[1:], "--trust", "false"]) == 1
            assert f"the run imports the module {module} (its" in capsys.readouterr().err
    assert not (tmp_path / "ran").exists()


def test_what_is_installed_is_trusted(short: Path, tmp_path: Path) -> None:
    for env in ("CartPole-v1", "gymnasium.envs:CartPole-v1", "neuralq_envs:neuralq/MitchellGrid-v0"):
        refuse_strangers({"env": env, "body": "mlp"})
    run = Path(shutil.copytree(short, tmp_path / "run"))
    assert main(["evaluate", str(run), "--episodes", "1", "--trust", "false", "--json"]) == 0
