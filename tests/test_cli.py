"""The command line: what it prints, what it refuses and with which exit status.

Mutants that must die here: the configuration file winning over the command line · a preset winning over either ·
--print-config without the environment · unknown keys passed over · settings of another learner ignored · status 0 for
a target that was not reached · anything after the JSON object on standard output · a seed that is not used.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces

from neuralq.apps.cli import COMMANDS, main, option_table
from neuralq.learners import learner_kinds
from neuralq.runs import RunConfig
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.recipe.config import config_from_dict

KEYS = {"env_steps", "cpu_seconds", "wall_seconds", "greedy_return", "parameters_sha256", "run_dir"}
TINY = ["--total-steps", "200", "--evaluate-every", "5000", "--evaluation-episodes", "2"]
SMALL = ["--preset", "false", "--rollout.num-envs", "2", "--rollout.num-steps", "16", "--hidden", "8"]

Capture = pytest.CaptureFixture[str]


def run(argv: list[str]) -> int:
    """The exit status, also where argparse ends the process."""
    try:
        return main(argv)
    except SystemExit as ended:
        return int(ended.code or 0)


def refusal(capsys: Capture, argv: list[str], status: int) -> str:
    """The one line that a refused command prints."""
    assert run(argv) == status
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    if lines[-1].startswith("  in "):  # where in somebody's own code
        lines.pop()
    assert not captured.out and "Traceback" not in captured.err
    assert len(lines) <= 3, captured.err  # what is prepared, what is wrong, and where in somebody's own code
    assert lines[-1].startswith("neuralq: ")
    return lines[-1]


def configuration(capsys: Capture, argv: list[str]) -> dict[str, Any]:
    """What --print-config prints."""
    assert run(["train", *argv, "--print-config"]) == 0
    loaded: dict[str, Any] = yaml.safe_load(capsys.readouterr().out)
    return loaded


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "run"
    assert main(["train", "CartPole-v1", *TINY, *SMALL, "--run-dir", str(path)]) == 0
    return path


def test_help_imports_nothing_heavy_and_names_every_command() -> None:
    program = (
        "import sys; from neuralq.apps.cli import main\n"
        "try: main(['--help'])\n"
        "finally: print(sorted({'torch', 'numpy', 'gymnasium', 'numba', 'scipy', 'rich', 'yaml', 'jsonargparse'}"
        " & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    *text, imported = ended.stdout.splitlines()
    assert imported == "[]"
    assert all(any(line.split()[:1] == [name] for line in text) for name in COMMANDS)
    assert "neuralq train CartPole-v1" in ended.stdout and not ended.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_itself_with_an_example(command: str, capsys: Capture) -> None:
    assert run([command, "--help"]) == 0
    text = capsys.readouterr().out
    usage, _, rest = text.partition("\n\n")
    assert usage.startswith(f"usage: neuralq {command}") and len(usage.splitlines()) <= 5
    assert f"\n  neuralq {command}" in rest[rest.index("example") :]
    assert "--json" in text and "_dir" not in text and "num_envs" not in text


def test_no_command_and_an_unknown_command(capsys: Capture) -> None:
    assert run([]) == 2
    assert "neuralq train" in capsys.readouterr().err
    assert run(["trian"]) == 2
    assert "trian" in capsys.readouterr().err


# Results.


@pytest.mark.filterwarnings("default:nothing is left to do")
def test_train_and_resume_end_with_one_json_object(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "run"
    results = []
    for argv in (
        ["train", "CartPole-v1", *TINY, *SMALL, "--run-dir", str(path), "--json"],
        ["resume", str(path), "--json"],
    ):
        assert main(argv) == 0
        (line,) = capsys.readouterr().out.splitlines()
        results.append(json.loads(line))
    assert results[0] == results[1] and results[0].keys() >= KEYS
    result = results[0]
    assert result["run_dir"] == str(path) and result["env_steps"] >= 200 and len(result["parameters_sha256"]) == 64
    assert 0 < result["cpu_seconds"] and 0 < result["wall_seconds"] and result["greedy_return"] > 0
    assert (path / "report.html").exists() and (path / "summary.json").exists()


def test_the_result_for_people_goes_to_standard_output_and_the_rest_beside_it(tmp_path: Path, capsys: Capture) -> None:
    assert main(["train", "CartPole-v1", *TINY, *SMALL, "--run-dir", str(tmp_path / "run")]) == 0
    captured = capsys.readouterr()
    assert "environment steps" in captured.out and str(tmp_path / "run") in captured.out
    assert "resumes bit-exact" in captured.err


@pytest.mark.filterwarnings("default:nothing is left to do")
@pytest.mark.parametrize(("target", "status"), [("5", 0), ("499", 1)])
def test_the_exit_status_says_whether_the_target_was_reached(
    target: str, status: int, tmp_path: Path, capsys: Capture
) -> None:
    argv = ["train", "CartPole-v1", *SMALL, "--total-steps", "150", "--evaluate-every", "64", "--json"]
    argv += ["--evaluation-episodes", "2", "--stop-at-return", target, "--run-dir", str(tmp_path / "run")]
    assert main(argv) == status
    captured = capsys.readouterr()
    result = json.loads(captured.out.splitlines()[-1])
    assert result["reached"] is (status == 0)
    assert ("target of 499 was not reached" in captured.err) is (status == 1)
    assert (result["env_steps"] < 150) is (status == 0)
    assert main(["resume", str(tmp_path / "run"), "--json"]) == status
    assert json.loads(capsys.readouterr().out)["parameters_sha256"] == result["parameters_sha256"]


def test_a_seed_decides_everything(tmp_path: Path, capsys: Capture) -> None:
    hashes = []
    for i, seed in enumerate(("3", "3", "4")):
        argv = ["train", "CartPole-v1", *TINY, *SMALL, "--seed", seed, "--run-dir", str(tmp_path / str(i)), "--json"]
        assert main(argv) == 0
        result = json.loads(capsys.readouterr().out)
        hashes.append((result["parameters_sha256"], result["env_steps"], result["greedy_return"]))
    assert hashes[0] == hashes[1]
    assert hashes[0][0] != hashes[2][0]


def test_evaluate_and_report_read_a_run(trained: Path, capsys: Capture) -> None:
    assert main(["evaluate", str(trained), "--episodes", "5", "--seed", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result["returns"]) == 5 and result["greedy_return"] == pytest.approx(np.mean(result["returns"]))
    assert result["lengths"] == result["returns"], "a step of CartPole is worth 1"
    assert main(["evaluate", str(trained), "--episodes", "5", "--seed", "1"]) == 0
    assert f"mean return {result['greedy_return']:.2f} ±" in capsys.readouterr().out
    assert main(["report", str(trained), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"report": str(trained / "report.html")}


def test_solve_and_baird_end_with_json(capsys: Capture) -> None:
    assert main(["solve", "neuralq/MitchellGrid-v0", "--gamma", "0.9", "--json"]) == 0
    # Mitchell (1997), figure 13.2: the values that γ = 0.9 gives, and 0 for the absorbing goal.
    assert sorted(json.loads(capsys.readouterr().out)["v"]) == pytest.approx([0, 81, 90, 90, 100, 100], abs=1e-6)
    assert main(["solve", "CartPole-v1"]) == 1
    assert "Traceback" not in capsys.readouterr().err
    assert main(["baird", "--num-steps", "50", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["baird"]
    assert len(rows) == 5 and all(row["predicted_growth"] > 0 for row in rows)


# Configurations.


def test_the_printed_configuration_is_one_that_runs(tmp_path: Path, capsys: Capture) -> None:
    argv = [
        "CartPole-v1",
        *TINY,
        *SMALL,
        "--layer-norm",
        "true",
        "--seed",
        "9",
        "--env-kwargs",
        '{"sutton_barto_reward": true}',
    ]
    printed = configuration(capsys, argv)
    assert (
        printed["env"] == "CartPole-v1" and printed["body"]["hidden"] == [8] and printed["body"]["layer_norm"] is True
    )
    file = tmp_path / "run.yaml"
    file.write_text(yaml.safe_dump(printed))
    assert configuration(capsys, ["--config", str(file)]) == printed
    assert main(["train", "--config", str(file), "--run-dir", str(tmp_path / "run")]) == 0
    assert config_from_dict(read_config(tmp_path / "run")) == config_from_dict(printed)
    capsys.readouterr()
    again = configuration(capsys, ["--config", str(tmp_path / "run" / "config.json")])
    assert again == printed, "a run's config.json is a configuration file too"


def test_the_command_line_wins_over_the_file_and_the_file_over_the_preset(tmp_path: Path, capsys: Capture) -> None:
    preset = configuration(capsys, ["CartPole-v1"])
    plain = configuration(capsys, ["CartPole-v1", "--preset", "false"])
    assert preset["reward_scale"] != plain["reward_scale"] == RunConfig().reward_scale
    file = tmp_path / "some.yaml"
    file.write_text("env: CartPole-v1\nseed: 5\nreward_scale: 0.3\nrollout: {num_envs: 6, num_steps: 10}\n")
    # wherever the file is named, and with the environment before or behind
    for argv in (["--config", str(file), "--seed", "7"], ["--seed", "7", "CartPole-v1", "--config", str(file)]):
        merged = configuration(capsys, [*argv, "--rollout.num-steps", "20"])
        assert (merged["seed"], merged["reward_scale"]) == (7, 0.3)
        assert (merged["rollout"]["num_envs"], merged["rollout"]["num_steps"]) == (6, 20)
        assert merged["rollout"]["learning_rate"] == preset["rollout"]["learning_rate"]
        assert merged["body"] == preset["body"]


def test_small_numbers_of_a_runs_configuration_are_numbers(tmp_path: Path, capsys: Capture) -> None:
    file = tmp_path / "config.json"
    file.write_text(json.dumps({"env": "CartPole-v1", "reward_scale": 1e-05}))
    assert "1e-05" in file.read_text()  # which YAML takes for a word
    assert configuration(capsys, ["--config", str(file)])["reward_scale"] == 1e-05


def test_a_presets_network_is_left_out_where_there_is_none(capsys: Capture) -> None:
    for layout in ("table", "linear"):
        assert configuration(capsys, ["CartPole-v1", "--layout", layout])["body"] is None


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("total_stepz: 5", "unknown key 'total_stepz'; did you mean total_steps?"),
        ("rollout: {num_envz: 5}", "rollout has unknown keys num_envz; known are"),
        ("replay: {capacity: 500}", "settings for the replay learner would be ignored"),
        (
            "learner: sarsa",
            "learner must be one of 'rollout', 'replay', 'online', 'streaming', 'gradient', 'tabular', got 'sarsa'",
        ),
        ("learner: [rollout]", "learner must be text, got ['rollout']"),
        ("total_steps: many", "total_steps must be a whole number, got 'many'"),
        ("total_steps: 2.5", "total_steps must be a whole number, got 2.5"),
        ("gamma: true", "gamma must be a number, got True"),
        ("rollout: {anneal: 1}", "rollout.anneal must be true or false, got 1"),
        ("rollout: 5", "rollout must be a mapping, got 5"),
        ("body: {class: Deep}", "class of the body must be one of 'MLP', 'Conv', 'Custom', 'GRU', got 'Deep'"),
        ("body: {class: MLP, hidden: 64}", "body.hidden must be a list, got 64"),
        ("body: {class: MLP, hidden: [a]}", "body.hidden[0] must be a whole number, got 'a'"),
        ("- 5", "must hold a mapping of options, got list"),
        ("a: [", "cannot read --config"),
    ],
)
def test_a_file_with_a_mistake_is_refused_in_one_line(content: str, said: str, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "bad.yaml").write_text(content)
    assert said in refusal(capsys, ["train", "CartPole-v1", "--config", str(tmp_path / "bad.yaml")], 2)


# Combinations.

LAYOUTS = ["table", "linear", "action-input", "separate", "action-output"]
LEARNERS: dict[str, list[str]] = {
    "rollout": ["--rollout.num-envs", "3", "--rollout.num-steps", "8"],
    "replay": ["--replay.learning-starts", "50", "--replay.batch-size", "8", "--replay.capacity", "200"],
    "online": ["--online.lambda", "0.5"],
    "streaming": ["--streaming.lambda", "0.5"],
}


@pytest.mark.slow
@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_goes_with_every_learner(layout: str, learner: str, tmp_path: Path, capsys: Capture) -> None:
    argv = [
        "train",
        "FrozenLake-v1",
        "--env-kwargs",
        '{"is_slippery": false}',
        "--learner",
        learner,
        "--layout",
        layout,
    ]
    argv += [*TINY, *LEARNERS[learner], "--run-dir", str(tmp_path / "run"), "--json", "--total-steps", "120"]
    assert main([*argv, *([] if layout in ("table", "linear") else ["--hidden", "8"])]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["env_steps"] >= 120 and result["greedy_return"] in (0.0, 0.5, 1.0)
    assert read_config(tmp_path / "run")["env_kwargs"] == {"is_slippery": False}


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--layout", "table", "--hidden", "8"], "a table has no network body"),
        (["--layout", "linear", "--body", "{class: MLP}"], "a linear function has no network body"),
        (["--replay.batch-size", "3"], "--replay.batch-size is for the replay learner, and this is a rollout run"),
        (["--learner", "online", "--rollout.num-envs=3"], "add --learner rollout or leave it out"),
        (["--learner", "sarsa"], "--learner"),
        (["--layout", "tables"], "--layout"),
        (["--engine", "compiled", "--layout", "linear"], "kernels for MLP networks only"),
        (["--total-steps", "many"], "--total-steps must be a whole number, got many"),
        (["--total-steps", "-1"], "total_steps must be a whole number of at least 1, got -1"),
        (["--gamma", "1.5"], "gamma must lie in [0, 1], got 1.5"),
        (["--rollout.lambda", "7"], "lambda_ must lie in [0, 1], got 7.0"),
        (["--seed", "-4"], "seed must be a whole number of at least 0"),
        (["--hidden", "8,x"], "--hidden takes whole numbers like 64,64, got '8,x'"),
        (["--activation", "sine"], "activation must be one of"),
        (["--env-kwargs", "{x"], "--env-kwargs must be a mapping, got {x"),
        (
            ["--body", "3"],
            "body must be a mapping with a class, one of mlp, minatar, conv, gru, or 'module:Class' of your own, "
            "got '3'",
        ),
        (["--foo", "3"], "unrecognized arguments: --foo 3; `neuralq train --help` lists the options"),
        (["Acrobot-v1"], "one environment at a time, got 'CartPole-v1' and 'Acrobot-v1'"),
        (["--seed"], "--seed"),
        (["--config", "/nowhere.yaml"], "cannot read --config /nowhere.yaml"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(argv: list[str], said: str, capsys: Capture) -> None:
    assert said in refusal(capsys, ["train", "CartPole-v1", *argv], 2)


def test_training_needs_an_environment(capsys: Capture) -> None:
    assert "name an environment, e.g. neuralq train CartPole-v1" in refusal(capsys, ["train"], 2)


class Continuous(gym.Env[Any, Any]):
    """An environment whose actions are real numbers."""

    observation_space = spaces.Box(0, 1, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)


gym.register("test/Continuous-v0", Continuous)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["NoSuchEnv-v7"], ["cannot make the environment 'NoSuchEnv-v7'", "your_module:YourEnv-v0"]),
        (["no_such_module:Env-v0"], ["cannot make the environment 'no_such_module:Env-v0'", "no_such_module"]),
        (["test/Continuous-v0"], ["Box", "Discrete"]),
        (["CartPole-v1", "--layout", "table"], ["table"]),
        (["CartPole-v1", "--env-kwargs", '{"mars": 1}'], ["cannot make the environment 'CartPole-v1'", "'mars'"]),
        (["CartPole-v1", "--device", "toaster"], ["cannot compute on device 'toaster'", "device='cpu' always works"]),
        (["CartPole-v1", "--device", "meta"], ["device 'meta'"]),
    ],
)  # fmt: skip
def test_what_cannot_be_trained_is_one_error_and_leaves_no_run(
    argv: list[str], said: list[str], tmp_path: Path, capsys: Capture
) -> None:
    line = refusal(capsys, ["train", *argv, "--run-dir", str(tmp_path / "run")], 1)
    assert all(part in line for part in said), line
    assert not (tmp_path / "run").exists()


def test_a_module_that_fails_to_import_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    (tmp_path / "broken_games.py").write_text("import nothing_of_that_name\n")
    monkeypatch.syspath_prepend(tmp_path)
    line = refusal(capsys, ["train", "broken_games:Game-v0", "--run-dir", str(tmp_path / "run")], 1)
    assert "broken_games:Game-v0" in line and "nothing_of_that_name" in line


def test_a_run_is_never_written_over(trained: Path, capsys: Capture) -> None:
    before = sorted((p, p.stat().st_mtime_ns) for p in trained.rglob("*"))
    line = refusal(capsys, ["train", "CartPole-v1", "--tensorboard", "--run-dir", str(trained)], 1)
    assert "already holds a run" in line and f"neuralq resume {trained}" in line
    assert sorted((p, p.stat().st_mtime_ns) for p in trained.rglob("*")) == before


@pytest.mark.parametrize("command", ["resume", "evaluate", "report"])
def test_a_folder_without_a_run_is_one_error(command: str, tmp_path: Path, capsys: Capture) -> None:
    line = refusal(capsys, [command, str(tmp_path / "nothing")], 1)
    assert str(tmp_path / "nothing") in line


def test_counts_out_of_range_are_refused(trained: Path, capsys: Capture) -> None:
    assert "num_episodes" in refusal(capsys, ["evaluate", str(trained), "--episodes", "0"], 1)
    assert "seed" in refusal(capsys, ["evaluate", str(trained), "--seed", "-1"], 1)
    assert "total_steps" in refusal(capsys, ["resume", str(trained), "--total-steps", "0"], 1)
    assert run(["solve", "FrozenLake-v1", "--env-kwargs", "{x"]) == 2
    assert "--env-kwargs: must be a mapping, got {x" in capsys.readouterr().err


def test_tensorboard_files_are_written_and_continued(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "run"
    argv = ["train", "CartPole-v1", *TINY, *SMALL, "--log-every", "50", "--tensorboard", "--run-dir", str(path)]
    assert main(argv) == 0
    events = list((path / "tensorboard").glob("events.out.tfevents.*"))
    assert len(events) == 1 and events[0].stat().st_size > 200
    assert main(["resume", str(path), "--total-steps", "400"]) == 0
    assert len(list((path / "tensorboard").iterdir())) == 2


def test_a_missing_extra_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    argv = ["train", "CartPole-v1", *TINY, "--tensorboard", "--run-dir", str(tmp_path / "run")]
    assert 'pip install "neuralq[tensorboard]"' in refusal(capsys, argv, 1)


def test_the_help_of_settings_is_read_from_docstrings_of_every_version_of_python() -> None:
    text = """A claim.

    Args:
        first: what is said
            on two lines.
        second: the other.

    Example:
        >>> third: 1
    """
    wanted = {"first": "what is said on two lines.", "second": "the other."}
    # As compiled up to 3.12, from 3.13 on, and under -OO: by itself, and as a dataclass fills it in.
    for doc, found in ((text, wanted), (inspect.cleandoc(text), wanted), (None, {}), ("Some(first: int)", {})):
        assert option_table._field_help(type("Some", (), {"__doc__": doc})) == found
    assert {f.name for f in dataclasses.fields(RunConfig)} <= option_table._field_help(
        RunConfig
    ).keys() | learner_kinds().keys()


@pytest.mark.slow
def test_commands_run_without_docstrings_and_assertions(tmp_path: Path) -> None:
    words = ["train", "CartPole-v1", *TINY, *SMALL, "--run-dir", str(tmp_path / "run")]
    for argv in (["train", "--help"], ["train", "--learner", "replay", "--help"], words, ["evaluate", words[-1]]):
        done = subprocess.run([sys.executable, "-OO", "-m", "neuralq", *argv], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


@pytest.mark.whole
def test_where_there_are_no_file_locks_it_is_said_in_one_line() -> None:
    """As on Windows."""
    code = (
        "import sys; sys.modules['fcntl'] = None\ntry: from neuralq import train\n"
        "except ImportError as error: print(error)\n"
        "from neuralq.apps.cli import main\nsys.exit(main(['presets']))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 1 and ended.stderr.count("\n") == 1 and "WSL 2" in ended.stderr
    assert ended.stdout.startswith("neuralq runs on Linux and macOS")
