"""Runs of QRC(λ) and GQ(λ): settings and their sources, where the second function starts, what a run is made of.

Their resuming is tested in tests/test_resume.py, their learning and its negative controls in
tests/test_negative_controls.py, masks in tests/test_masks.py, layouts in tests/test_recipes_matrix.py.

Mutants that must die here: a published number changed · a setting that would be ignored let through · a second function
that starts as the first, or whose hidden layers are zero as well · GQ's ratio left at 1 · observations seen raw.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import GradientSettings, HeadCorrection, TangentCorrection
from neuralq.learners.gradient.settings import gradient_learner, started_at_zero
from neuralq.q import MLP, Conv, Custom
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import RunConfig, load, train
from neuralq.runs.recipe.build import build_q, build_session
from neuralq.runs.stream import ObservationSpec
from neuralq.types import Transition


def test_the_published_numbers_are_the_defaults() -> None:
    """From the authors' configuration for MinAtar (Elelimy et al. 2025): q_lr 1e-4, h_lr_scale 0.1, β = 1, λ = 0.8."""
    chosen = GradientSettings()
    assert (chosen.method, chosen.lambda_, chosen.step_size, chosen.beta) == ("qrc", 0.8, 1e-4, 1.0)
    assert chosen.step_size_h == pytest.approx(1e-5) and chosen.cut == "watkins" and chosen.scale_rewards
    greedy_gq = GradientSettings(method="gq")  # Maei et al. 2010: λ = 0, no regularisation, greedy target
    assert (greedy_gq.lambda_, greedy_gq.beta, greedy_gq.target_epsilon) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"method": "gq", "cut": "naive"}, "would be ignored: method='gq' cuts its traces by the importance ratio"),
        ({"target_epsilon": 0.1}, "would be ignored: method='qrc' bootstraps from the best action"),
        ({"method": "tdc"}, "method must be one of 'qrc', 'gq'"),
        ({"method": "gq", "target_epsilon": 1.5}, "target_epsilon must"),
        ({"lambda_": 1.5}, "lambda_ must"),
        ({"step_size": 0.0}, "step_size must"),
        ({"step_size_h": -1.0}, "step_size_h must"),
        ({"beta": -1.0}, "beta must"),
        ({"cut": "published"}, "cut must be one of"),
    ],
)
def test_nonsense_is_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        GradientSettings(**given)


def test_there_are_no_kernels_to_force() -> None:
    with pytest.raises(ValueError, match="no kernels for gradient TD"):
        RunConfig(learner="gradient", engine="compiled")


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    ("layout", "body", "dueling"),
    [
        ("linear", None, False),
        ("action-output", MLP((6, 5), layer_norm=True), False),
        ("action-output", MLP((6, 5)), True),
        ("separate", MLP((6,)), False),
        ("action-input", MLP((6,)), False),
        ("action-output", Custom("neuralq.q.custom:Example"), False),
        ("action-output", Conv((2,), hidden=(4,)), False),
    ],
)
def test_the_second_function_starts_at_zero_and_can_learn(layout: str, body: Any, dueling: bool, masked: bool) -> None:
    shape = (4, 4, 2) if isinstance(body, Conv) else (3,)
    outer = (int(np.prod(shape)) + 2,) if masked else shape
    spec = ObservationSpec(outer, np.dtype(np.float32), shape, None, masked, 2)
    config = RunConfig(learner="gradient", layout=layout, body=body, dueling=dueling)
    head: Any = started_at_zero(build_q(config, spec, np.random.default_rng(0)))
    s = torch.rand(5, *outer, generator=torch.Generator().manual_seed(0)) + 0.1
    assert torch.equal(head.all(s), torch.zeros(5, 2))
    HeadCorrection(head)
    head.at(s, torch.arange(5) % 2).sum().backward()
    assert any(bool((p.grad != 0).any()) for p in head.parameters())
    if layout not in ("linear", "table"):
        assert any(bool((p != 0).any()) for p in head.parameters()), "hidden layers keep their weights"


def test_gq_weights_traces_by_the_ratio_of_its_policy() -> None:
    """Two steps on a table by hand: α = 1, λ = ½, γ = 1, greedy target, μ = ½, so that the older trace counts 2·½."""
    from neuralq.q import TableQ

    settings = GradientSettings(method="gq", lambda_=0.5, step_size=1.0, step_size_h=1e-12)
    learner = gradient_learner(TorchEngine(TableQ(3, 2), Loss()), settings, TableQ(3, 2))
    assert isinstance(learner._core.correction, TangentCorrection)

    def step(s: int, a: int, r: float, s_next: int, last: bool) -> None:
        row = torch.tensor
        learner.update(Transition(*map(row, ([s], [a], [0.5], [r], [0.0 if last else 1.0], [s_next], [last]))))

    step(0, 0, 0.0, 1, False)
    step(1, 0, 8.0, 2, True)  # greedy (ties go to the lowest): z(0, 0) = 2 · ½ · 1, z(1, 0) = 1
    values = learner.engine.all(torch.arange(3))
    torch.testing.assert_close(values[:2, 0], torch.tensor([8.0, 8.0], dtype=values.dtype), rtol=0, atol=1e-6)
    step(0, 0, 8.0, 1, False)  # δ = 8 + 8 − 8
    step(1, 1, 2.0, 2, True)  # not greedy: the ratio is 0, and nothing of it reaches (0, 0)
    values = learner.engine.all(torch.arange(3))
    torch.testing.assert_close(values[0, 0], torch.tensor(16.0, dtype=values.dtype), rtol=0, atol=1e-6)
    assert float(values[1, 1]) == pytest.approx(2.0, abs=1e-6)


def test_a_run_sees_its_stream_normalised_and_can_be_loaded(tmp_path: Path) -> None:
    config = RunConfig(
        learner="gradient", gradient=GradientSettings(step_size=1e-3), body=MLP((8,)), total_steps=150,
        evaluate_every=150, evaluation_episodes=1,
    )  # fmt: skip
    session = build_session(config)
    try:
        assert session.stream.normalisation is not None and session.stream.num_envs == 1
        # The second function is drawn for itself: below its last layer it is not a copy of the first.
        second: Any = session.learner._core.correction.head  # type: ignore[attr-defined]
        first: Any = session.learner.engine.q
        assert not torch.equal(first.trunk.layers[0].weight, second.trunk.layers[0].weight)
    finally:
        session.close()
    run = train(config, tmp_path / "run")
    assert run.env_steps == 150
    agent = load(run.run_dir)
    assert agent.normalisation is not None and np.isfinite(agent.values(np.zeros(4, np.float32))).all()
    assert train(config, tmp_path / "again").parameters_sha256 == run.parameters_sha256
