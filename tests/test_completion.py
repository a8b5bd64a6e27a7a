"""What a shell completes: commands, a command's options, environments, learners; asked of the shells themselves.

Mutants that these tests kill: a command left out; options of one learner only; options with underscores; a question of
the lab without its options.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from neuralq.apps.cli import COMMANDS, main
from neuralq.runs.recipe.config import LEARNERS

COMPLETED = [
    (["neuralq", ""], list(COMMANDS)),
    (["neuralq", "tr"], ["train"]),
    (["neuralq", "train", "--lay"], ["--layout", "--layer-norm"]),
    (["neuralq", "train", "CartP"], ["CartPole-v1"]),
    (["neuralq", "train", "neuralq/Mit"], ["neuralq/MitchellGrid-v0"]),
    *((["neuralq", "train", "CartPole-v1", f"--{one}.lam"], [f"--{one}.lambda"]) for one in LEARNERS),
    (["neuralq", "lab", "diag"], ["diagnose"]),
    (["neuralq", "lab", "run", "--samp"], ["--sampling"]),
    (["neuralq", "completion", "z"], ["zsh"]),
]


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def needs(shell: str) -> str:
    found = shutil.which(shell)
    if found is None:
        pytest.skip(f"{shell} is not installed")
    return found


def test_bash_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "script").write_text(script("bash", capsys))
    asked = "\n".join(
        f"COMP_WORDS=({' '.join(repr(word) for word in words)}); COMP_CWORD={len(words) - 1}; COMPREPLY=(); "
        '_shtab_neuralq neuralq "" "" ; echo "${COMPREPLY[*]}"'
        for words, _ in COMPLETED
    )
    program = f"source {tmp_path / 'script'}\n{asked}"
    ended = subprocess.run([needs("bash"), "--norc", "-c", program], capture_output=True, text=True, check=True)
    for (words, expected), line in zip(COMPLETED, ended.stdout.splitlines(), strict=True):
        assert set(expected) <= set(line.split()), (words, line)
        assert all(one.startswith(words[-1]) for one in line.split())


def test_fish_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "script").write_text(script("fish", capsys))
    for words, expected in COMPLETED:
        program = f"source {tmp_path / 'script'}; complete -C {' '.join(words)!r}"
        ended = subprocess.run(
            [needs("fish"), "--no-config", "-c", program], capture_output=True, text=True, check=True
        )  # fmt: skip
        offered = {line.split("\t")[0] for line in ended.stdout.splitlines()}
        assert set(expected) <= offered, (words, offered)


def test_zsh_takes_the_script_and_knows_every_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = script("zsh", capsys)
    (tmp_path / "_neuralq").write_text(text)
    program = f"fpath=({tmp_path} $fpath); autoload -U compinit; compinit -u -d {tmp_path}/dump; print $_comps[neuralq]"
    ended = subprocess.run([needs("zsh"), "-f", "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "_neuralq"
    assert all(f'"{name}:' in text or f"'{name}:" in text or f"{name})" in text for name in COMMANDS)
    subprocess.run([needs("zsh"), "-n", str(tmp_path / "_neuralq")], check=True)


def test_an_unknown_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["completion", "tcsh"])
    assert ended.value.code == 2 and "'bash', 'zsh', 'fish'" in capsys.readouterr().err.replace('"', "'")


def test_the_script_comes_as_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash", "--json"]) == 0
    assert '"shell": "bash"' in capsys.readouterr().out
