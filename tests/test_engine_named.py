"""A run says what computed it, so that nobody takes autograd's speed for that of the kernels.

Mutants that must die here: kernels claimed where torch computed · the line said although torch was asked for.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from neuralq.apps.cli import main
from neuralq.learners import ReplaySettings, StreamingSettings
from neuralq.q import MLP, Custom
from neuralq.runs import RunConfig
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.recipe import build
from neuralq.runs.recipe.build import build_session, engine_name

CASES = [
    (RunConfig(body=MLP((8,))), "compiled"),
    (RunConfig(body=MLP((8,)), engine="torch"), "torch"),
    (RunConfig(layout="linear"), "torch"),
    (RunConfig(body=Custom("neuralq.q.custom:Example")), "torch"),
    (RunConfig(learner="replay", replay=ReplaySettings(distribution="quantile", num_atoms=4), body=MLP((8,))), "torch"),
    (RunConfig(learner="replay", replay=ReplaySettings(target_rule="dqrc"), body=MLP((8,))), "compiled and torch"),
    (RunConfig(learner="streaming", body=MLP((8,))), "compiled"),
    (RunConfig(learner="streaming", layout="linear"), "compiled and torch"),
    (RunConfig(learner="streaming", streaming=StreamingSettings(), body=MLP((8,)), engine="torch"), "torch"),
    (RunConfig(learner="gradient", body=MLP((8,))), "compiled and torch"),
]


def is_slow(config: RunConfig, name: str) -> bool:
    """Streaming kernels take seconds to compile."""
    return config.learner == "streaming" and name == "compiled"


@pytest.mark.parametrize(
    ("config", "name"),
    [
        pytest.param(c, n, id=f"{c.learner} {c.layout} {n}", marks=[pytest.mark.slow] if is_slow(c, n) else [])
        for c, n in CASES
    ],
)
def test_the_engine_is_named(config: RunConfig, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "is_resumable", lambda *_: Resumability(False, "not asked"))
    session = build_session(config)
    try:
        assert engine_name(session.learner) == name
    finally:
        session.close()


def test_a_run_says_so_unless_it_was_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--preset", "false", "--layout", "linear", "--rollout.num-envs", "2", "--rollout.num-steps", "16"]
    words += ["--total-steps", "32", "--evaluation-episodes", "1"]
    assert main(["train", "CartPole-v1", *words, "--run-dir", str(tmp_path / "auto")]) == 0
    assert "computed by torch: there are no kernels" in capsys.readouterr().err
    assert main(["train", "CartPole-v1", *words, "--engine", "torch", "--run-dir", str(tmp_path / "told")]) == 0
    assert "computed by torch" not in capsys.readouterr().err
    assert read_config(tmp_path / "told")["engine"] == "torch"
