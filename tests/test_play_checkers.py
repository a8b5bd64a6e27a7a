"""Checkers on its page: whole games, captures jump by jump, undo, refusals, the agent's word, and the browser.

Mutants that die: a jump that is kept when the first one is refused, undo that leaves the record, the quiet plies or the
score; a result counted although the game was set up; a move ranked among the agent's; the board turned for the wrong
side; a target of a click sent as its source.
"""

from __future__ import annotations

import functools
import re
import shutil
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette", reason="the extra web is not installed")

from neuralq.apps.web.play import Offer, Seats
from neuralq.apps.web.play_checkers import CheckersGame, checkers
from neuralq.systems.checkers import CheckersPlayer, RankedMove
from neuralq_envs.checkers import Position


def greedy(position: Position) -> list[RankedMove]:
    """Counts pieces after its move, and looks no further: nothing has to be compiled for it."""
    ranked = [
        RankedMove(one, float(one.position.other.bit_count() - one.position.own.bit_count()))
        for one in position.moves()
    ]
    return sorted(ranked, key=lambda one: -one.score)


def counting() -> Offer:
    real = checkers(CheckersPlayer(depth=2))  # it is never asked
    return Offer(real.page, functools.partial(CheckersGame, greedy), real.new, real.actions)


@pytest.fixture
def seats() -> Seats:
    return Seats(counting())


def do(seats: Seats, state: dict[str, Any], name: str, **fields: Any) -> dict[str, Any]:
    return seats.act(name, {"seat": state["seat"], "revision": state["revision"], **fields})


def without(state: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in state.items() if name not in {"revision", "before", "steps", *names}}


@pytest.mark.parametrize("player", ["black", "white"])
def test_games_are_played_to_their_end_with_moves_taken_back(seats: Seats, player: str) -> None:
    rng = np.random.default_rng(5)
    state = seats.start({"player": player, "seed": 3})
    assert len(state["record"]) == (player == "white")
    counted = {"you": 0, "draws": 0, "agent": 0}
    began = state
    for _ in range(3):
        while state["result"] is None:
            before, position = state, Position.from_fen(state["fen"])
            began = began if state["goes_on"] else state
            sources = sorted(state["moves"], key=int)
            source = str(rng.choice(sources))
            state = do(seats, state, "move", source=int(source), target=int(rng.choice(state["moves"][source])))
            if not state["goes_on"] and len(state["record"]) > len(before["record"]):
                mine = state["record"][len(before["record"])]
                ranked = greedy(position)
                (score,) = [one.score for one in ranked if str(one.move) == mine["text"]][:1]
                assert mine["who"] == "you" and mine["loss"] == ranked[0].score - score
                assert mine["rank"] == 1 + sum(one.score > score for one in ranked)
                if state["result"] is None:
                    answer = greedy(next(one.move.position for one in ranked if str(one.move) == mine["text"]))
                    assert state["agent_move"]["best"][0]["score"] == answer[0].score
            if rng.random() < 0.3:
                assert without(do(seats, state, "undo")) == without(before if state["goes_on"] else began)
                state = seats.act("state", {"seat": state["seat"]})
        counted[state["result"]["winner"] or "draws"] += 1
        assert state["score"] == counted and not state["moves"]
        state = do(seats, state, "undo")
        counted[next(name for name, number in counted.items() if number > state["score"][name])] -= 1
        assert state["score"] == counted and state["result"] is None
        state = do(seats, state, "new", player=player)


def test_a_capture_is_made_jump_by_jump(seats: Seats) -> None:
    state = seats.start({"position": "B:W10,19,28,32:B6,1"})
    assert state["moves"] == {"6": [15]} and state["must_capture"] and not state["counts"]
    state = do(seats, state, "move", source=6, target=15)
    assert state["goes_on"] and state["moves"] == {"15": [24]} and state["can_undo"]
    assert [i + 1 for i, sign in enumerate(state["squares"]) if sign] == [1, 15, 19, 28, 32]
    assert state["steps"] == [{"who": "you", "squares": [6, 15], "taken": [10]}]
    back = do(seats, state, "undo")
    assert back["moves"] == {"6": [15]} and back["squares"][9] == "w" and not back["can_undo"]
    state = do(seats, do(seats, back, "move", source=6, target=15), "move", source=15, target=24)
    assert state["record"][0]["text"] == "6x15x24" and state["record"][1] == {
        "who": "agent", "text": "28x19", "rank": 1, "loss": 0.0
    }  # fmt: skip
    assert state["steps"] == [{"who": "agent", "squares": [28, 19], "taken": [24]}]
    assert state["words"] == "You, black: men on 1. The agent, white: men on 19, 32."
    state = do(seats, state, "undo")
    assert state["record"] == [] and state["moves"] == {"6": [15]} and state["agent_move"] is None


def test_the_last_piece_wins_and_a_game_that_was_set_up_does_not_count(seats: Seats) -> None:
    state = do(seats, seats.start({"position": "B:W18:B14,K32"}), "move", source=14, target=23)
    assert state["result"] == {"winner": "you", "blocked": False} and sum(state["score"].values()) == 0
    assert do(seats, state, "undo")["result"] is None
    state = do(seats, seats.start({"position": "B:W5:B1,K15"}), "move", source=15, target=10)
    assert state["result"] == {"winner": "you", "blocked": True}


def test_sixty_quiet_plies_are_a_draw() -> None:
    def stays(position: Position) -> list[RankedMove]:
        return [
            RankedMove(one, -float(one.squares[-1])) for one in sorted(position.moves(), key=lambda m: m.squares[-1])
        ]

    real = counting()
    seats = Seats(Offer(real.page, functools.partial(CheckersGame, stays), real.new, real.actions))
    state = seats.start({"position": "B:WK1:BK32"})
    for number in range(30):
        assert state["result"] is None and state["quiet_plies"] == 2 * number
        state = do(seats, state, "move", source=(32, 28)[number % 2], target=(28, 32)[number % 2])
    assert state["result"] == {"winner": None, "blocked": False} and state["quiet_plies"] == 60
    state = do(seats, state, "undo")
    assert state["quiet_plies"] == 58 and len(state["record"]) == 58


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"source": 9, "target": 18}, "9 to 18 is not legal: a man goes one square ahead and aslant"),
        ({"source": 9, "target": 5}, "5 is not empty"),
        ({"source": 21, "target": 17}, "no piece of yours is on 21"),
        ({"source": 15, "target": 18}, "no piece of yours is on 15"),
        ({"source": 0, "target": 5}, "source must be a whole number from 1 to 32, got 0"),
        ({"source": 9}, "target must be a whole number from 1 to 32, got nothing"),
    ],
)
def test_what_is_not_legal_is_refused_and_changes_nothing(seats: Seats, fields: dict[str, Any], says: str) -> None:
    state = seats.start({"player": "black"})
    with pytest.raises(ValueError, match=re.escape(says)):
        do(seats, state, "move", **fields)
    assert seats.act("state", {"seat": state["seat"]}) == state


def test_captures_that_are_due_and_positions_that_are_none(seats: Seats) -> None:
    state = seats.start({"position": "B:W10,19,28,32:B6,1"})
    for source, target, says in ((1, 5, "a piece can be captured, and one must be"), (6, 9, "one must be")):
        with pytest.raises(ValueError, match=says):
            do(seats, state, "move", source=source, target=target)
    state = do(seats, state, "move", source=6, target=15)
    with pytest.raises(ValueError, match="the piece on 15 must go on capturing"):
        do(seats, state, "move", source=1, target=5)
    thirteen = "B:W32:B" + ",".join(map(str, range(1, 14)))
    for position, says in (
        (thirteen, "a side has at most 12 pieces, got 13 of black"),
        ("nonsense", "a position must be written like"),
        (7, "position must be a line like"),
        ("B:W32:B" + "1," * 300, "position must be a line like"),
        ("W:W5:B1", "the game is over in W:W5:B1"),
    ):
        with pytest.raises(ValueError, match=says):
            do(seats, state, "new", position=position)
    with pytest.raises(ValueError, match="leave player out, or position"):
        do(seats, state, "new", position="B:W32:B1", player="black")
    with pytest.raises(ValueError, match="nothing to take back"):
        do(seats, seats.start({"player": "white"}), "undo")


@pytest.mark.slow
def test_the_agents_word_is_that_of_its_search() -> None:
    seats, player = Seats(checkers(CheckersPlayer(depth=6, seed=0))), CheckersPlayer(depth=6, seed=1)
    state = seats.start({"player": "white", "seed": 1})
    for _ in range(4):
        position = Position.from_fen(state["fen"])
        best = seats.act("hint", {"seat": state["seat"]})
        assert best["best"][0]["score"] == pytest.approx(player.score(position))
        assert best["num_moves"] == len(position.moves())
        move = next(one for one in position.moves() if str(one) == best["best"][0]["text"])
        for source, target in zip(move.squares, move.squares[1:], strict=False):
            state = do(seats, state, "move", source=source, target=target)
        mine = [entry for entry in state["record"] if entry["who"] == "you"][-1]
        assert (mine["rank"], mine["loss"]) == (1, 0.0)
        after = player.score(move.position)
        assert state["agent_move"]["best"][0]["score"] == pytest.approx(after)
    state = do(seats, state, "new", position="B:W5:B1,K15,K32")
    found = seats.act("hint", {"seat": state["seat"]})["best"][0]
    assert found["plies"] == 1 and found["score"] == pytest.approx(99.99)


# ---- in the browser


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no chromium: apt-get install chromium")
def test_the_page_by_mouse_and_by_keyboard() -> None:
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    from playwright.sync_api import sync_playwright
    from test_play_page import served

    def settled(page: Any, revision: int) -> None:
        end = time.monotonic() + 60
        while int(page.evaluate("document.body.dataset.revision ?? 0")) < revision and time.monotonic() < end:
            page.wait_for_timeout(30)
        assert int(page.evaluate("document.body.dataset.revision")) == revision

    with served(counting()) as url, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 400, "height": 800}, reduced_motion="reduce")
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(f"{url}?seed=1")
        settled(page, 1)
        # Black is below: square 1 is in the last row, at the right.
        boxes = {one: page.locator(f"[data-square='{one}']").bounding_box() for one in (1, 4, 29)}
        assert boxes[1]["y"] > boxes[29]["y"] and boxes[1]["x"] > boxes[4]["x"]
        page.click("[data-square='11']")
        page.click("[data-square='15']")
        settled(page, 2)
        assert page.locator(".record li").count() == 2 and page.locator(".squares .piece").count() == 24
        page.keyboard.press("u")
        settled(page, 3)
        assert page.locator(".record li").count() == 0 and page.is_disabled("#undo")
        page.fill("#set-position", "B:W10,19,28,32:B6,1")
        page.press("#set-position", "Enter")
        settled(page, 4)
        page.evaluate("document.activeElement.blur()")
        page.keyboard.press("ArrowUp")  # the one piece that can capture
        assert page.evaluate("document.activeElement.dataset.square") == "6"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.dataset.square") == "15"
        page.keyboard.press("Enter")
        settled(page, 5)
        assert page.inner_text("#status") == "Go on: the same piece captures again."
        assert page.evaluate("document.activeElement.dataset.square") == "24"  # and the same piece is chosen
        page.keyboard.press("Enter")
        settled(page, 6)
        assert page.locator(".squares .piece").count() == 3
        page.keyboard.press("h")
        page.wait_for_selector("#hint-best table")
        page.fill("#set-position", "B:W32:B" + ",".join(map(str, range(1, 14))))
        page.press("#set-position", "Enter")
        page.wait_for_selector("#error:not([hidden])")
        assert "at most 12 pieces, got 13 of black" in page.inner_text("#error")
        assert page.evaluate("document.documentElement.scrollWidth") <= 400 and not complaints
        browser.close()
