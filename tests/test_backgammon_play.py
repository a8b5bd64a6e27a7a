"""Backgammon as one sees and plays it: pictures, the Gymnasium and the PettingZoo environment, the benchmark.

Mutants that die here: a row of checkers that is not drawn; the reward of a loss for a win.
"""

from __future__ import annotations

import importlib.util
import json
import re
import runpy
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from backgammon_slowly import row
from gymnasium.utils.env_checker import check_env

import neuralq_envs
from neuralq_envs.backgammon import Position

neuralq_envs.register()


def test_the_board_in_letters() -> None:
    position = Position(row({1: 9, 13: 2, 25: 3}), row({6: 11, 25: 2}))
    assert position.text(dice=(6, 5)) == (
        "+13-14-15-16-17-18-+---+-19-20-21-22-23-24-+  O: 116 pips, 2 off\n"
        "| X                | O |  O                |\n"
        "| X                | O |  O                |\n"
        "|                  |   |  O                |\n"
        "|                  |   |  O                |\n"
        "|                  |   |  b                |\n"
        "|                  |BAR|                   |\n"
        "|                  |   |                 9 |\n"
        "|                  |   |                 X |\n"
        "|                  | X |                 X |\n"
        "|                  | X |                 X |\n"
        "|                  | X |                 X |\n"
        "+12-11-10--9--8--7-+---+--6--5--4--3--2--1-+  X: 110 pips, 1 off, to play 6-5\n"
    )
    assert str(position) == position.text()
    assert position.text(seat=1).splitlines()[12].endswith("O: 116 pips, 2 off")  # the other player at the bottom
    assert position.text(seat=1).splitlines()[0].endswith("X: 110 pips, 1 off, to move")


def test_the_board_as_svg() -> None:
    position = Position(row({1: 9, 13: 2, 25: 3}), row({6: 11, 25: 2}), turn=1)
    for seat in (0, 1):
        root = ET.fromstring(position.svg(seat, dice=(6, 5)))
        space = {"s": "http://www.w3.org/2000/svg"}
        assert len(root.findall(".//s:circle", space)) == 30  # borne off ones lie in the tray
        piles = {}
        for pile in root.findall("s:g", space):
            kinds = [circle.get("class") for circle in pile.findall("s:circle", space)]
            assert len(kinds) == int(pile.get("data-count", -1)) and len(set(kinds)) <= 1
            if kinds:
                piles[pile.get("data-point"), kinds[0]] = len(kinds)
        mine, theirs = ("o", "x") if seat == 1 else ("x", "o")
        seen = {("1", "o"): 9, ("13", "o"): 2, ("19", "x"): 11} if seat == 1 else {}
        seen = seen or {("24", "o"): 9, ("12", "o"): 2, ("6", "x"): 11}
        seen |= {("bar", "o"): 3, ("bar", "x"): 2, ("off", "o"): 1, ("off", "x"): 2}
        assert piles == seen and mine != theirs
        assert re.findall(r">([1-6])</text>", position.svg(seat, dice=(6, 5)))[-2:] == ["6", "5"]


def test_the_environment_passes_gymnasiums_checker_and_pays_what_the_game_pays() -> None:
    env = gymnasium.make("neuralq/Backgammon-v0")
    check_env(env.unwrapped)
    seen: list[Position] = []

    def opponent(position: Position, dice: tuple[int, int]) -> Position:
        seen.append(position)
        return position.afterstates(dice)[-1]

    env = gymnasium.make("neuralq/Backgammon-v0", opponent=opponent)
    rng, rewards = np.random.default_rng(8), []
    for episode in range(30):
        observation, extra = env.reset(seed=episode)
        while True:
            choices = extra["afterstates"]
            assert extra["action_mask"].sum() == len(choices) and extra["action_mask"][: len(choices)].all()
            assert all(choice.turn == 1 for choice in choices) and observation[196] == 1
            chosen = int(rng.integers(len(choices)))
            observation, reward, terminated, truncated, extra = env.step(chosen)
            assert not truncated and (reward == 0) != terminated
            if terminated:
                winner = 0 if choices[chosen].winner == 0 else 1
                assert (reward > 0) == (winner == 0) and abs(reward) in (1, 2, 3)
                assert observation[98 * winner + 97] == 1  # all off
                break
            assert seen[-1] == choices[chosen] and seen[-1].turn == 1
        rewards.append(reward)
        assert extra["afterstates"] == () and not extra["action_mask"].any()
        with pytest.raises(ValueError, match="call reset"):
            env.step(0)
    assert min(rewards) < 0 < max(rewards)


def test_an_episode_can_begin_anywhere_and_the_seed_decides_the_rest() -> None:
    env = gymnasium.make("neuralq/Backgammon-v0", render_mode="ansi")
    last = Position(row({1: 1}), row({23: 1, 7: 14}), turn=1)
    _, extra = env.reset(seed=0, options={"position": last})
    assert len(extra["afterstates"]) == 1 and "X: 1 pips, 14 off" in env.render()
    illegal = env.step(5)
    assert illegal[1:4] == (0.0, False, False) and illegal[4]["afterstates"] == extra["afterstates"]
    assert env.step(0)[1:4] == (3.0, True, False)
    with pytest.raises(ValueError, match="the game is over"):
        env.reset(options={"position": last.afterstates((2, 1))[0]})
    runs = [[env.reset(seed=9)[0].tolist()] + [env.step(0)[0].tolist() for _ in range(20)] for _ in range(2)]
    assert runs[0] == runs[1]
    cheat = gymnasium.make("neuralq/Backgammon-v0", opponent=lambda position, dice: Position.initial())
    with pytest.raises(ValueError, match="is no afterstate"):
        for seed in range(9):
            cheat.reset(seed=seed)
            cheat.step(0)
    with pytest.raises(ValueError, match="opponent must be one of 'random'"):
        gymnasium.make("neuralq/Backgammon-v0", opponent="gnubg")


def test_the_turn_based_environment_is_pettingzoos() -> None:
    from neuralq_envs.backgammon.two_agents import make_aec

    if importlib.util.find_spec("pettingzoo") is None:
        with pytest.raises(ImportError, match="pip install pettingzoo"):
            make_aec()
        pytest.skip("pettingzoo is not installed")
    with warnings.catch_warnings():  # its tests warn of its own environments and of observations that are dicts
        warnings.simplefilter("ignore")
        from pettingzoo.test import api_test, seed_test

        api_test(make_aec(), num_cycles=200)
        seed_test(make_aec, num_cycles=30)
    env, rng = make_aec(render_mode="ansi"), np.random.default_rng(9)
    env.reset(seed=0)
    for agent in env.agent_iter():
        observation, _, termination, _, extra = env.last()
        if termination:
            env.step(None)
            continue
        choices = extra["afterstates"]
        assert observation["action_mask"].sum() == len(choices) and str(choices[0]) != env.render()
        chosen = int(rng.integers(len(choices)))
        env.step(chosen)
        if choices[chosen].winner is not None:
            assert env.rewards[agent] == choices[chosen].points == -sum(env.rewards.values()) + env.rewards[agent]
    assert env.agents == []


def test_the_benchmark_reports(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["bench_backgammon.py", "--games=20", "--rounds=1", "--json"])
    runpy.run_path(str(Path(__file__).parents[1] / "scripts" / "bench_backgammon.py"), run_name="__main__")
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(found) == 4 and all(rate > 0 for rate in found.values())
