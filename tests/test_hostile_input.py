"""Input that is absurd, and surroundings that are bare: one error, or the same result."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from neuralq.apps.cli import main
from neuralq.apps.cli.yaml_text import read_yaml
from neuralq.checks import check_whole
from neuralq.runs.recipe.config import fitted_value

Capture = pytest.CaptureFixture[str]
NINES = "9" * 400
TINY = ["--total-steps", "64", "--evaluation-episodes", "1", "--rollout.num-envs", "2", "--rollout.num-steps", "16"]
LAYERS = [f"{x}: &{x} [{', '.join([f'*{y}'] * 9)}]" for x, y in zip("bcdefghij", "abcdefghi", strict=True)]
BOMB = f"{{{', '.join(['a: &a [0, 0, 0, 0, 0, 0, 0, 0, 0]', *LAYERS])}}}"


def refusal(capsys: Capture, argv: list[str]) -> str:
    """The one line of a refusal, in good time."""
    began = time.monotonic()
    try:
        status = main(argv)
    except SystemExit as ended:
        status = int(ended.code or 0)
    said = capsys.readouterr().err
    assert status in (1, 2) and time.monotonic() - began < 20
    assert "Traceback" not in said
    line = said.strip().splitlines()[-1]
    assert line.startswith("neuralq") and len(line) < 700
    return line


@pytest.mark.parametrize(
    "argv",
    [
        *(
            ["train", "CartPole-v1", option, NINES]
            for option in ("--seed", "--total-steps", "--gamma", "--rollout.num-envs", "--hidden", "--seeds")
        ),
        ["train", "td-gammon", "--seed", NINES], ["baird", "--seed", NINES], ["baird", "--num-upper", NINES],
        ["solve", "FrozenLake-v1", "--gamma", NINES], ["solve", "FrozenLake-v1", "--max-iterations", NINES],
        ["lab", "run", "baird", "--seed", NINES], ["lab", "run", "baird", "--num-steps", NINES],
        ["train", "CartPole-v1", "--seed", "9" * 5000], ["train", "CartPole-v1", "--seed", "1e400"],
    ],
)  # fmt: skip
def test_a_number_of_hundreds_of_digits_is_one_line(argv: list[str], capsys: Capture) -> None:
    refusal(capsys, argv)


def test_whole_numbers_have_128_bits() -> None:
    check_whole("seed", 2**128 - 1)
    check_whole("seed", np.int64(2**63 - 1))  # type: ignore[arg-type]
    for value in (2**128, -(2**128), 10**400):
        with pytest.raises(ValueError, match="below 2"):
            check_whole("seed", value)
    assert fitted_value("x", 10**20, int) == 10**20 and fitted_value("x", 10**20, float) == 1e20
    with pytest.raises(ValueError, match="must be a number"):
        fitted_value("x", 10**400, float)


@pytest.mark.parametrize("option", ["--gamma", "--seed", "--env-kwargs", "--body", "--stop-at-return"])
def test_an_alias_bomb_is_refused_in_good_time(option: str, capsys: Capture) -> None:
    said = "10,000 values" if option in ("--env-kwargs", "--body") else "must be a "  # a number is not read as YAML
    assert said in refusal(capsys, ["train", "CartPole-v1", option, BOMB])


def test_yaml_that_others_would_cut_or_never_finish_is_refused(tmp_path: Path, capsys: Capture) -> None:
    assert read_yaml("{a: &x [1, 2], b: *x}") == {"a": [1, 2], "b": [1, 2]}
    assert read_yaml("base: &b {x: 1}\nmore:\n  <<: *b\n  y: 2") == {"base": {"x": 1}, "more": {"x": 1, "y": 2}}
    for text, wanted in (
        ("{a: 1, a: 2}", "'a' is given twice"), ("- {b: {a: 1, c: 2, a: 3}}", "'a' is given twice"),
        ("&a [*a]", "a part of"), ("[" * 3000 + "]" * 3000, "nested too deeply"), (BOMB, "10,000 values"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=wanted):
            read_yaml(text)
    with pytest.raises(yaml.YAMLError):
        read_yaml("[1")
    for name, text in (
        ("twice.yaml", "gamma: 0.9\ngamma: 0.8\n"), ("twice.json", '{"gamma": 0.9, "gamma": 0.8}'),
        ("deep.json", "[" * 5_000), ("bomb.yaml", BOMB), ("list.yaml", "- 1"),
    ):  # fmt: skip
        (tmp_path / name).write_text(text)
        assert name in refusal(capsys, ["train", "CartPole-v1", "--config", str(tmp_path / name)])


def test_options_are_not_dropped_beside_a_scalar(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "scalar.yaml").write_text("rollout: 3\n")
    argv = ["train", "CartPole-v1", "--config", str(tmp_path / "scalar.yaml"), "--rollout.num-envs", "8"]
    assert "rollout must be a mapping" in refusal(capsys, argv)
    (tmp_path / "numbers.yaml").write_text("rollout: {1: 2}\n")
    argv[3] = str(tmp_path / "numbers.yaml")
    refusal(capsys, argv)


def done(argv: list[str], **given: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "neuralq", *argv]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, **given}, check=False)


def in_a_shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, shell=True, capture_output=True, text=True, check=False)


@pytest.mark.whole
def test_a_terminal_that_knows_ascii_only_is_told_in_ascii() -> None:
    told = done(["--help"], PYTHONIOENCODING="ascii")
    assert told.returncode == 0 and "lambda" in told.stdout and "?" not in told.stdout and told.stdout.isascii()


@pytest.mark.slow
def test_every_text_can_be_told_in_ascii(tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    for argv in (
        ["train", "CartPole-v1", *TINY, "--run-dir", run], ["evaluate", run, "--episodes", "2"], ["train", "--help"],
        ["solve", "neuralq/MitchellGrid-v0", "--gamma", "0.9"], ["baird", "--num-steps", "20"], ["chapter"],
        ["lab", "diagnose", "baird"], ["presets"],
    ):  # fmt: skip
        told = done(argv, PYTHONIOENCODING="ascii")
        assert told.returncode == 0 and told.stdout.isascii(), told.stderr
    told = done(["solve", "neuralq/MitchellGrid-v0", "--gamma", "0.9"], PYTHONIOENCODING="ascii")
    assert "^-> | 90 ^->" in told.stdout


@pytest.mark.slow
def test_closed_streams_take_nothing_along(tmp_path: Path) -> None:
    command = f'"{sys.executable}" -m neuralq train CartPole-v1 {" ".join(TINY)} --json --run-dir'
    for closing in ("2>&-", "<&- 2>&-"):
        told = in_a_shell(f'{command} "{tmp_path}/{len(closing)}" {closing}')
        assert told.returncode == 0 and json.loads(told.stdout)["env_steps"] >= 64, "and nothing else is on stdout"
    told = in_a_shell(f'{command} "{tmp_path}/out" >&-')
    assert told.returncode == 0 and "run folder" in told.stderr


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["rollout", "replay", "streaming", "online", "gradient"])
def test_without_a_compiler_everything_is_interpreted(learner: str, tmp_path: Path) -> None:
    words = [
        "--total-steps",
        "40",
        "--evaluation-episodes",
        "1",
        "--learner",
        learner,
        "--preset",
        "false",
        "--hidden",
        "4",
    ]
    if learner == "replay":
        words += ["--replay.learning-starts", "20", "--replay.prioritised", "true", "--replay.batch-size", "8"]
    told = done(["train", "CartPole-v1", *words, "--run-dir", str(tmp_path / "run")], NUMBA_DISABLE_JIT="1")
    assert told.returncode == 0, told.stderr
