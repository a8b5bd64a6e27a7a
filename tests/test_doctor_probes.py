"""The probes on a learner that is right, and on the same learner with each mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuralq.apps.cli import main
from neuralq.doctor.probes import GAMMA, PROBES, ProbeEnv, probe
from neuralq.types import Array


def learner(
    env: ProbeEnv, budget: int, *, gamma: float = GAMMA, blind: bool = False, cut_ends: bool = False, sign: float = 1.0,
    wrong_action: bool = False, late: int = 0, rate: float | None = None, median: bool = False,
) -> Any:  # fmt: skip
    """Tabular Q-learning with step sizes 1/n; what is named is done wrongly."""
    rng, num = np.random.default_rng(0), int(env.action_space.n)  # type: ignore[attr-defined]
    q: dict[float, Array] = {}
    n: dict[float, Array] = {}
    past: list[float] = []
    s, _ = env.reset(seed=1)
    for _ in range(budget):
        a = int(rng.integers(num))
        s_t, r, terminated, truncated, _ = env.step(a)
        past.append(float(s[0]))
        key = 0.0 if blind else past[-1 - min(late, len(past) - 1)]
        ahead = 0.0 if blind else float(s_t[0])
        row, count = q.setdefault(key, np.zeros(num)), n.setdefault(key, np.zeros(num))
        stops = terminated or (cut_ends and truncated)
        target = sign * r + (0.0 if stops else gamma * q.setdefault(ahead, np.zeros(num)).max())
        b = 0 if wrong_action else a
        count[b] += 1
        size = 20 / (20 + count[b]) if rate is None else rate
        row[b] += size * (np.sign(target - row[b]) if median else target - row[b])
        s = env.reset()[0] if terminated or truncated else s_t
    return lambda obs: np.array([q.get(0.0 if blind else float(o[0]), np.zeros(num)) for o in obs])


MISTAKES: dict[str, tuple[dict[str, Any], int]] = {  # and the first probe that has to fail
    "sign": ({"sign": -1.0}, 0),
    "blind": ({"blind": True}, 1),
    "discount": ({"gamma": 0.5}, 2),
    "action": ({"wrong_action": True}, 3),
    "mixed": ({"late": 1}, 1),
    "limit": ({"cut_ends": True}, 5),
    "noise": ({"rate": 0.5}, 7),
}


def first_broken(**mistake: Any) -> list[int]:
    found = probe(lambda env, budget: learner(env, budget, **mistake), 3000, say=lambda text: None)
    return [number for number, one in enumerate(found) if one.flagged]


def test_a_learner_without_mistakes_passes_every_probe() -> None:
    assert first_broken() == []


@pytest.mark.parametrize(
    "name", [name if name == "limit" else pytest.param(name, marks=pytest.mark.slow) for name in MISTAKES]
)
def test_each_mistake_fails_the_probe_that_is_meant_for_it(name: str) -> None:
    mistake, number = MISTAKES[name]
    broken = first_broken(**mistake)
    assert number in broken and (number == broken[0] or name == "noise")


def test_known_values_are_the_expected_returns_of_the_environments() -> None:
    """Played out: the mean discounted return of each first action, then the best,
    from every observation asked about."""
    for one in PROBES:
        env, rng = ProbeEnv(one), np.random.default_rng(0)
        env.reset(seed=0)
        total: dict[tuple[float, int], list[float]] = {}
        for _ in range(300):
            s, _ = env.reset()
            a, first, steps, paid = int(rng.integers(one.num_actions)), float(s[0]), 0, 0.0
            b, over = a, False
            while not over and steps < 200:
                _, r, terminated, truncated, _ = env.step(b)
                paid += GAMMA**steps * r
                steps += 1
                if truncated:
                    env.reset()
                over, b = terminated, 0
            total.setdefault((first, a), []).append(paid)
        for k, s0 in enumerate(one.asked[:, 0]):
            for a in range(one.num_actions):
                if (float(s0), a) in total:
                    got = total[float(s0), a]
                    assert abs(np.mean(got) - one.values[k, a]) < 0.01 + 4 * np.std(got) / np.sqrt(len(got)), one.name


def test_the_command_names_what_is_broken_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "zeros.py").write_text(
        "import numpy\ndef train(env, budget):\n    return lambda obs: numpy.zeros((len(obs), env.action_space.n))\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["probe", "zeros:train", "--budget", "10", "--json"]) == 1
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [one["flagged"] for one in told["findings"]] == [True, True, True, True, True, True, True, False]
    assert main(["probe", "zeros:nothing"]) == 2 and main(["probe", "nowhere:train"]) == 2
    assert "module:function" in capsys.readouterr().err
