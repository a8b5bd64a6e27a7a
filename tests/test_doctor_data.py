"""What was learned from, wherever it lies: a run's own replay, files of two layouts, data sets of Minari's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from test_doctor_exam import ENDS, Strict, case_of, few_episodes, tempting, worth  # noqa: F401

import neuralq
from neuralq.doctor import examination, load_subject
from neuralq.doctor.exam import stored, values
from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.exam.stored import COLUMNS
from neuralq.runs.offline.minari_files import write_minari
from neuralq.runs.offline.recorded import Recorded


class Gears(gym.Env[Any, Any]):
    """Observations of two parts, one of them scaled by its bounds; counts up, and ends or is cut after seven steps."""

    observation_space = spaces.Dict({"speed": spaces.Box(-100, 100, (2,), np.float32), "gear": spaces.Discrete(3)})
    action_space = spaces.Discrete(2, start=1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.ends = 0, bool(self.np_random.integers(2))
        return self.seen(), {}

    def seen(self) -> dict[str, Any]:
        return {"speed": np.array([10 * self.t, -self.t], np.float32), "gear": self.t % 3}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.t += 1
        return self.seen(), 10.0 * self.t + float(action), self.t == 7 and self.ends, self.t == 7 and not self.ends, {}


def test_a_runs_own_replay_and_composite_observations_come_in_the_environments_units(tmp_path: Path) -> None:
    run = neuralq.train(
        Gears, tmp_path / "run", preset=False, learner="replay", total_steps=140, learning_starts=100, hidden=(8,),
        evaluation_episodes=1, reward_scale=0.5, num_envs=2, resume_probe=False,
    )  # fmt: skip
    agent = neuralq.load(run, env=Gears)
    subject = load_subject(run.run_dir, env=Gears)
    env = Gears()
    env.reset(seed=0)
    seen = [env.step(1)[0] for _ in range(5)]
    flat = np.stack([np.asarray(spaces.flatten(Gears.observation_space, one)) for one in seen])
    assert np.allclose(subject.values(flat), np.stack([agent.values(one) for one in seen]), atol=1e-6)
    assert subject.replay is not None
    found = subject.replay()
    assert found is not None and {len(column) for column in found.values()} == {140}
    t = np.tile(np.arange(7), 20)  # flat: gear, one-hot, then speed
    assert np.allclose(found["obs"][:, 3], 10 * t) and np.allclose(found["next_obs"][:, 3], 10 * (t + 1))
    assert (found["obs"][:, :3].argmax(1) == t % 3).all()
    assert set(found["action"]) == {1, 2} and np.allclose(found["reward"], 10 * (t + 1) + found["action"])
    ends = found["terminated"] | found["truncated"]
    assert (ends == (t == 6)).all() and found["terminated"].any() and found["truncated"].any()


class MaskedGears(Gears):
    """Only what a gear allows: the gear itself and the one above, of three actions."""

    action_space = spaces.Discrete(3)

    def _allowed(self) -> dict[str, Any]:
        return {"action_mask": np.isin(np.arange(3), [self.t % 3, (self.t + 1) % 3]).astype(np.int8)}

    def reset(self, **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        return super().reset(**given)[0], self._allowed()

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        return *super().step(action)[:4], self._allowed()


def test_masks_that_a_run_stores_in_its_observations_are_columns_of_their_own(tmp_path: Path) -> None:
    run = neuralq.train(
        MaskedGears, tmp_path / "run", preset=False, learner="replay", total_steps=70, learning_starts=69, hidden=(8,),
        batch_size=8, evaluation_episodes=1, num_envs=2, resume_probe=False,
    )  # fmt: skip
    replay = load_subject(run.run_dir, env=MaskedGears).replay
    found = replay() if replay is not None else None
    assert found is not None and found["obs"].shape == (70, 5)
    t = np.tile(np.arange(7), 10)
    legal = lambda at: np.isin(np.arange(3), [0, 1]) if at == 0 else np.isin(np.arange(3), [at % 3, (at + 1) % 3])  # noqa: E731
    assert np.array_equal(found["action_mask"], [legal(at) for at in t])
    assert np.array_equal(found["next_action_mask"], [legal(at + 1) for at in t])
    assert np.allclose(found["obs"][:, 3], 10 * t) and np.allclose(found["next_obs"][:, 3], 10 * (t + 1))
    assert found["action_mask"][np.arange(70), found["action"]].all()


def masked_case(allows: Any = lambda t: [t % 3], ends: bool = True, **columns: Any) -> Case:
    """Twelve episodes of `Strict`, in which every step pays 2, stored as if it paid 1/2; values are those of 1 each."""
    t = np.tile(np.arange(ENDS), 12)
    last = t == ENDS - 1
    rows = {
        "obs": t[:, None] * 1.0, "next_obs": t[:, None] + 1.0, "action": t % 3, "reward": np.full(len(t), 0.5),
        "terminated": last & ends, "truncated": last & (not ends),
    }  # fmt: skip
    data = {name: column for name, column in {**rows, **columns}.items() if column is not None}
    subject = tempting(lambda t: worth(ENDS - t))
    return case_of(lambda: Strict(allows, pays=lambda t, a: 2.0), subject, data=data)


def masks(allows: Any) -> Any:
    return np.tile([np.isin(np.arange(3), allows(t)) for t in range(ENDS)], (12, 1))


def test_errors_on_stored_data_are_those_of_the_best_legal_action() -> None:
    """(1/2 − 1)² = 1/4 on the data and (2 − 1)² on fresh steps; an illegal action would be worth a million."""
    mine = masks(lambda t: [t % 3])
    for given in (
        masked_case(action_mask=mine),
        masked_case(action_mask=mine, next_action_mask=np.roll(mine, -1, axis=0)),
        masked_case(action_mask=mine, ends=False),  # of which the steps after the last are not known: they are left out
    ):
        assert values.generalisation(given).value == pytest.approx(4.0)
    blind = masked_case(action_mask=mine, next_action_mask=0 * mine, ends=False)
    with pytest.raises(CannotMeasure, match="no stored step"):
        values.generalisation(blind)


@pytest.mark.parametrize(("taken", "most"), [([0, 1], 0.5), ([0, 0], 1.0)])
def test_actions_are_counted_where_there_is_a_choice(taken: list[int], most: float) -> None:
    """In nine of ten steps action 0 is all that is legal."""
    allows = lambda t: [0, 1] if t % 10 == 9 else [0]  # noqa: E731
    acted = np.zeros(12 * ENDS, int)
    acted[9::10] = np.tile(taken, 18)
    found = stored.actions_taken(masked_case(allows, action=acted, action_mask=masks(allows)))
    assert found.value == most and found.flagged == (most > 0.95)


def test_where_data_do_not_say_what_was_legal_only_what_needs_it_is_left_out() -> None:
    silent = masked_case()
    for measure in (values.generalisation, stored.actions_taken):
        with pytest.raises(CannotMeasure, match="a column action_mask"):
            measure(silent)
    assert not any(measure(silent).flagged for measure in (stored.merged_ends, stored.reset_leak, stored.rewards_seen))
    with pytest.raises(CannotMeasure, match=r"shape \[2\], and there are 3"):
        stored.actions_taken(masked_case(action_mask=masks(lambda t: [0])[:, :2]))
    with pytest.raises(CannotMeasure, match="more than one action"):
        stored.actions_taken(masked_case(action_mask=masks(lambda t: [t % 3])))
    with pytest.raises(ValueError, match="'action_mask' has 4 rows"):
        masked_case(action_mask=np.ones((4, 3)))


STEPS: dict[str, Any] = {
    "observations": np.arange(6.0)[:, None], "actions": np.array([0, 1, 1, 0, 1, 0]), "rewards": np.ones(6),
    "terminations": np.array([0, 0, 1, 0, 0, 0], bool), "truncations": np.array([0, 0, 0, 0, 0, 1], bool),
}  # fmt: skip


def test_files_of_either_layout_are_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "d4rl.npz", **STEPS)
    found = examination._columns(tmp_path / "d4rl.npz")
    assert found is not None and found["obs"][:, 0].tolist() == [
        0,
        1,
        2,
        3,
        4,
    ]  # what the last step led to is not known
    assert found["next_obs"][:, 0].tolist()[:2] == [1, 2] and found["terminated"].tolist() == [0, 0, 1, 0, 0]
    np.savez(tmp_path / "d4rl.npz", **STEPS, action_mask=np.arange(12).reshape(6, 2))
    masked = examination._columns(tmp_path / "d4rl.npz")
    assert masked is not None and masked["action_mask"].tolist() == np.arange(10).reshape(5, 2).tolist()
    np.savez(tmp_path / "own.npz", **dict(zip(COLUMNS, [*STEPS.values(), np.ones((6, 1))], strict=True)))
    own = examination._columns(str(tmp_path / "own.npz"))
    assert own is not None and own["truncated"].tolist() == [0, 0, 0, 0, 0, 1]


def test_a_data_set_of_minaris_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    steps = {**STEPS, "observations": np.zeros((6, 4), np.float32), "next_observations": np.ones((6, 4), np.float32)}
    write_minari("doctor/cartpole-v0", Recorded(**steps), gym.make("CartPole-v1"), "none")
    found = examination._columns("minari:doctor/cartpole-v0")
    assert found is not None and found["action"].tolist() == [0, 1, 1, 0, 1, 0] and found["truncated"].tolist()[-1]
