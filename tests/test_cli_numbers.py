"""Numbers and mappings as people write them, on the command line and in files.

Mutants that die here: 2.3M as a float product · 100k as 100 · an underscore at an end · k read for a learner's settings
but not for the run's · YAML 1.1's numbers (1e5 a word, 010 eight, 1:30 ninety) · a text like a number printed without
quotes · a negative number with an exponent taken for an option.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from neuralq.apps.cli import command_parser, main
from neuralq.apps.cli.numbers import any_number
from neuralq.apps.cli.option_values import reader
from neuralq.apps.cli.yaml_text import read_text, read_yaml, write_yaml

Capture = pytest.CaptureFixture[str]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("100", 100), ("100k", 100_000), ("100K", 100_000), ("2.5M", 2_500_000), ("2.3M", 2_300_000), ("1G", 10**9),
        ("1_000_000", 1_000_000), ("1e5", 100_000), ("1E+5", 100_000), ("5e-4", 5e-4), (".5", 0.5), ("-1.1e2", -110),
        ("0.1", 0.1), ("1.5e-3k", 1.5), ("12345678901234567891", 12345678901234567891), ("3.", 3),
    ],
)  # fmt: skip
def test_numbers_as_people_write_them(text: str, value: float) -> None:
    assert any_number(text) == value and isinstance(any_number(text), type(value))


@pytest.mark.parametrize("text", ["10x", "k", "_1", "1_", "1__0", "1k0", "0x10", "1,000", "", "1 000", "2m"])
def test_what_is_no_number(text: str) -> None:
    with pytest.raises(ValueError):
        any_number(text)


def test_they_are_read_wherever_a_number_is_an_option(tmp_path: Path, capsys: Capture) -> None:
    words = ["--total-steps", "2.3M", "--gamma", "99e-2", "--stop-at-return", "-1.1e2", "--replay.capacity", "10k"]
    assert main(["train", "MountainCar-v0", "--learner", "replay", *words, "--print-config"]) == 0
    found = yaml.safe_load(capsys.readouterr().out)
    assert (found["total_steps"], found["gamma"], found["stop_at_return"]) == (2_300_000, 0.99, -110)
    assert found["replay"]["capacity"] == 10_000
    parser = command_parser("some", "text")
    parser.add_argument("--count", type=int)
    parser.add_argument("--rate", type=float)
    assert (
        vars(parser.parse_args(["--count", "1e3", "--rate", "-2.5e-1k"])).items()
        >= {"count": 1000, "rate": -250.0}.items()
    )
    for words, said in (
        (["--count", "1.5"], "must be a whole number, got '1.5'"),
        (["--rate", "x"], "must be a number"),
    ):
        with pytest.raises(SystemExit):
            parser.parse_args(words)
        assert said in capsys.readouterr().err


def test_none_is_no_number_where_there_may_be_none() -> None:
    assert reader(float | None)("none") is None and reader(int | None)("NULL") is None
    assert reader(float | None)("1k") == 1000.0


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{r: 1e39}", {"r": 1e39}), ('{"r": 1e39}', {"r": 1e39}), ("{r: 1e5}", {"r": 1e5}),
        ("{r: -1.5e-3}", {"r": -1.5e-3}),
        ("{n: 010}", {"n": 10}), ("{n: 0o10}", {"n": 8}), ("{n: 0x10}", {"n": 16}), ("{n: 1_000}", {"n": 1000}),
        ("{at: 1:30}", {"at": "1:30"}), ("{day: 2026-01-02}", {"day": "2026-01-02"}), ("{n: 100k}", {"n": "100k"}),
        ("{n: '1e5'}", {"n": "1e5"}), ("{a: true, b: null, c: .5}", {"a": True, "b": None, "c": 0.5}),
        ('{\n\t"a": 1\n}', {"a": 1}), ("{big: .inf, low: -.inf}", {"big": float("inf"), "low": -float("inf")}),
    ],
)  # fmt: skip
def test_mappings_are_yaml_or_json_with_the_numbers_of_yaml_1_2(text: str, value: dict[str, Any]) -> None:
    found = read_text(text)
    assert found == value and [type(x) for x in found.values()] == [type(x) for x in value.values()]
    assert read_yaml(write_yaml(value)) == value, "what is written is read as it was"


def test_env_kwargs_are_read_alike_by_every_command(capsys: Capture) -> None:
    for text in ("{is_slippery: false}", '{"is_slippery": false}', "is_slippery: false"):
        assert main(["solve", "FrozenLake-v1", "--gamma", "9e-1", "--env-kwargs", text, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["v"][0] == pytest.approx(0.9**5)
        assert main(["train", "FrozenLake-v1", "--env-kwargs", text, "--print-config"]) == 0
        assert yaml.safe_load(capsys.readouterr().out)["env_kwargs"] == {"is_slippery": False}
    with pytest.raises(SystemExit):
        main(["solve", "FrozenLake-v1", "--env-kwargs", "[1]"])
    assert "argument --env-kwargs: must be a mapping, got [1]" in capsys.readouterr().err


def test_options_are_spelled_with_hyphens_and_read_with_underscores(capsys: Capture) -> None:
    for words in (["--print-config", "--total-steps=1k"], ["--print_config", "--total_steps=1_000"]):
        assert main(["train", "CartPole-v1", *words]) == 0
        assert yaml.safe_load(capsys.readouterr().out)["total_steps"] == 1000
    for words in (["train", "--help"], ["lab", "fitted", "--help"], ["train", "td-gammon", "--help"]):
        with pytest.raises(SystemExit) if words[0] == "lab" else _nothing():
            main(words)
        assert not [
            word for word in capsys.readouterr().out.split() if word.startswith("--") and "_" in word.split("=")[0]
        ]


def _nothing() -> Any:
    import contextlib

    return contextlib.nullcontext()
