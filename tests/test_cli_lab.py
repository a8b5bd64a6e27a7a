"""``neuralq lab``: what it prints in narrow and wide terminals, what it refuses, and with which exit status.

Numbers are those of the literature or of closed forms: the star's γ threshold (n + 9)/(2n + 5) (15/17 for six upper
states) and its growth, two states turning at 5/6.

Mutants that die here: an option of the method that is not passed on; a γ that is not used; status 0 for a disagreement
or for a parameter without a critical value; a traceback for a slip of the keyboard; anything beside the JSON object on
standard output; a page served on all addresses by default; the missing extra as a traceback.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import neuralq.apps.cli.lab_matrix as lab_matrix
from neuralq.apps.cli import COMMANDS, main
from neuralq.apps.cli.lab import COMMANDS as LAB
from neuralq.lab import METHODS, PROBLEMS, Matrix

Capture = pytest.CaptureFixture[str]


def status(argv: list[str]) -> int:
    """The exit status, also where argparse ends the process."""
    try:
        return main(["lab", *argv])
    except SystemExit as ended:
        return int(ended.code or 0)


def answer(capsys: Capture, *argv: str, expected: int = 0) -> dict[str, Any]:
    """The JSON object, which is all there is on standard output."""
    assert status([*argv, "--json"]) == expected
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def printed(capsys: Capture, *argv: str) -> str:
    assert status(list(argv)) == 0
    return capsys.readouterr().out


def refusal(capsys: Capture, *argv: str, expected: int = 1) -> str:
    assert status(list(argv)) == expected
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err and "Error" not in captured.err
    assert captured.err.strip().splitlines()[-1].startswith("neuralq")
    return " ".join(captured.err.split())


def test_every_command_has_help_with_examples(capsys: Capture) -> None:
    assert COMMANDS["lab"][1] == "lab"
    for name in LAB:
        text = printed(capsys, name, "--help")
        assert f"neuralq lab {name}" in text and "example" in text and "--json" in text
    assert all(f"  {name}" in printed(capsys, "--help") for name in LAB)


def test_without_a_command_it_helps_and_with_a_wrong_one_it_lists_the_right_ones(capsys: Capture) -> None:
    assert status([]) == 2
    assert "neuralq lab --serve" in capsys.readouterr().err
    assert "prescribe" in refusal(capsys, "presribe", expected=2)


def test_list_names_everything(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    found = answer(capsys, "list")
    assert [one["name"] for one in found["problems"]] == [entry.name for entry in PROBLEMS]
    assert [one["name"] for one in found["methods"]] == [one.name for one in METHODS]
    monkeypatch.setenv("COLUMNS", "80")
    text = printed(capsys, "list")
    assert all(f" {entry.name} " in text for entry in PROBLEMS)  # no name is cut in a narrow terminal
    assert max(map(len, text.splitlines())) <= 80


def test_diagnose_passes_everything_on(capsys: Capture) -> None:
    found = answer(capsys, "diagnose", "baird", "--sampling", "markov")
    assert found["verdict"] == "diverges" and found["second_moment_radius"] > 1
    assert answer(capsys, "diagnose", "baird", "--gamma", "0.88")["verdict"] == "converges"  # below 15/17 = .8824
    assert answer(capsys, "diagnose", "baird", "--gamma", "0.885")["verdict"] == "diverges"
    assert answer(capsys, "diagnose", "baird", "--lambda", "0.95")["options"]["lambda_"] == 0.95
    ridge = answer(capsys, "diagnose", "w2w", "--method", "polyak-target", "--tau", "0.5", "--eta", "2")
    assert ridge["options"] == {"tau": 0.5, "eta": 2.0}
    assert answer(capsys, "diagnose", "baird", "--step-size", "0.02")["step_size"] == 0.02
    assert "diverges" in printed(capsys, "diagnose", "baird").split("\n")[0]


def test_critical_finds_published_boundaries(capsys: Capture) -> None:
    assert answer(capsys, "critical", "baird", "--parameter", "gamma")["critical"] == pytest.approx(15 / 17, rel=1e-9)
    found = answer(capsys, "critical", "baird", "--parameter", "lambda")
    assert found["stable"] == [[found["critical"], pytest.approx(1.0)]]
    found = answer(capsys, "critical", "baird", "--parameter", "gamma", "--lambda", "1", expected=1)  # never unstable
    assert found["critical"] is None
    assert "no critical value" in refusal(capsys, "critical", "kolter", "--parameter", "tau")


def test_prescribe_offers_what_converges(capsys: Capture) -> None:
    found = answer(capsys, "prescribe", "w2w")
    assert found["verdict"] == "diverges" and len(found["remedies"]) > 3
    assert all(one["spectral_radius"] < 1 for one in found["remedies"])
    assert "Nothing needs to be changed" in printed(capsys, "prescribe", "baird-tabular")


def test_prescribe_tells_each_remedy_in_full(capsys: Capture) -> None:
    assert "1. " in printed(capsys, "prescribe", "emphatic", "--explain")


def test_run_is_the_books_figure(capsys: Capture) -> None:
    """Sutton & Barto 2018, figure 11.2 right, by an independent float64 matrix iteration."""
    found = answer(capsys, "run", "baird", "--num-steps", "1000")
    assert found["rmsve"][-1][1] == pytest.approx(581.355105, rel=1e-6)
    assert (found["predicted"], found["contradiction"]) == ("diverges", False)
    text = printed(
        capsys, "run", "baird", "--method", "etd", "--sampling", "markov", "--seeds", "3", "--num-steps", "50"
    )
    assert "10% … 90%" in text and "predicted  converges" in text


def test_matrix_lists_judges_and_writes(capsys: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = ["--problem", "baird", "--problem", "w2w", "--method", "td", "--method", "fitted", "--method", "sarsa"]
    found = answer(capsys, "matrix", *some, "--csv", str(tmp_path / "m.csv"))
    assert (found["num_judged"], found["num_absent"], found["num_disagreements"]) == (4, 2, 0)
    with (tmp_path / "m.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 6
    for width in ("80", "120"):
        monkeypatch.setenv("COLUMNS", width)
        text = printed(capsys, "matrix", *some)
        assert "No disagreement." in text and "actions: the method compares actions" in text
        assert max(map(len, text.splitlines())) <= int(width)
    sampled = printed(capsys, "matrix", *some, "--sampling", "markov", "--seeds", "3", "--num-steps", "20")
    assert "sampled" in sampled and "– solves" in sampled


def test_the_whole_grid_fits_narrow_and_wide_terminals(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab_matrix, "_DETAILED", 0)
    some = ["--problem", "baird", "--problem", "w2w", "--method", "td", "--method", "sarsa", "--workers", "1"]
    for width in ("40", "80", "120"):
        monkeypatch.setenv("COLUMNS", width)
        text = printed(capsys, "matrix", *some)
        assert "✗✗ a" in text and "Each cell:" in text
        assert max(map(len, text.splitlines())) <= int(width)


@pytest.mark.slow
def test_processes_change_nothing(capsys: Capture) -> None:
    some = ["matrix", "--problem", "w2w", "--problem", "kolter", "--method", "td", "--method", "fitted"]
    assert answer(capsys, *some, "--workers", "2") == answer(capsys, *some, "--workers", "1")


def test_a_disagreement_ends_with_status_1_and_is_listed(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = lab_matrix.matrix_of

    def lying(*args: Any, **settings: Any) -> Matrix:
        found = honest(*args, **settings)
        return replace(found, cells=tuple(replace(cell, predicted="converges") for cell in found.cells))

    monkeypatch.setattr(lab_matrix, "matrix_of", lying)
    assert status(["matrix", "--problem", "baird", "--method", "td"]) == 1
    captured = capsys.readouterr()
    assert "1 disagree:" in captured.out and "1 of 1 cells disagree" in captured.err


def test_baird_from_every_side(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab_matrix, "METHODS", [one for one in METHODS if one.name in ("td", "etd", "sarsa")])
    found = answer(capsys, "baird", "--num-steps", "50")
    assert found["baird"][1]["predicted_growth"] == pytest.approx(1.0023925, abs=1e-7)
    verdicts = {cell["method"]: cell["predicted"] for cell in found["cells"]}
    assert verdicts["td"] == "diverges" and verdicts["etd"] == "converges" and "sarsa" not in verdicts
    assert found["num_disagreements"] == 0


@pytest.mark.parametrize(
    ("argv", "code", "message"),
    [
        (["diagnose", "nope"], 1, "no problem is called 'nope'"),
        (["diagnose", "baird", "--method", "nope"], 2, "invalid choice: 'nope'"),
        (["diagnose", "baird", "--tau", "3"], 2, "unrecognized arguments: --tau 3"),
        (["diagnose", "baird", "--gamma", "1"], 1, "choose a gamma below 1"),
        (["diagnose", "baird", "--gamma", "2"], 1, "gamma must lie in [0, 1]"),
        (["diagnose", "baird", "--step-size", "-1"], 1, "step_size"),
        (["diagnose", "baird", "--method", "sarsa"], 1, "compares actions"),
        (["critical", "baird", "--parameter", "luck"], 2, "invalid choice: 'luck'"),
        (["run", "baird", "--num-steps", "0"], 1, "num_steps must be a whole number"),
        (["run", "baird", "--seeds", "3"], 1, "num_seeds must be 1"),
        (["run", "spiral"], 1, "not linear in its weights"),
        (["matrix", "--problem", "nope"], 1, "no problem is called 'nope'"),
        (["matrix", "--method", "nope"], 1, "no method 'nope'"),
        (["matrix", "--seeds", "0"], 1, "--seeds must be a whole number"),
        (["matrix", "--problem", "w2w", "--method", "td", "--csv", "/nowhere/m.csv"], 1, "/nowhere/m.csv"),
        (["baird", "--gamma", "1"], 1, "gamma"),
        (["--serve", "--port", "99999"], 2, "--port must lie in 0..65535"),
    ],
)
def test_refusals_say_what_to_do(capsys: Capture, argv: list[str], code: int, message: str) -> None:
    assert message in refusal(capsys, *argv, expected=code)


def test_serve_stays_on_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int]] = []
    web = types.ModuleType("neuralq.apps.web")
    web.serve = lambda host, port: asked.append((host, port))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "neuralq.apps.web", web)
    assert status(["--serve"]) == 0
    assert status(["--serve", "--host", "0.0.0.0", "--port", "0"]) == 0
    assert asked == [("127.0.0.1", 8765), ("0.0.0.0", 0)]


def test_a_missing_extra_is_one_line_with_the_command(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "neuralq.apps.web", None)
    assert "pip install 'neuralq[web]'" in refusal(capsys, "--serve")


@pytest.mark.whole
def test_help_and_diagnosis_import_no_torch() -> None:
    code = (
        "import sys; from neuralq.apps.cli import main\n"
        "try: main(['lab', '--help'])\n"
        "except SystemExit: pass\n"
        "assert 'numpy' not in sys.modules\n"
        "main(['lab', 'diagnose', 'w2w', '--json'])\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)
