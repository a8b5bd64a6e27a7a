"""Games in a browser, without the browser: seats, refusals, undo, results, the agent's word, the exact answers.

Mutants that die: the revision not looked at; all seats sharing one game; a game that was set up counted; the agent's
turn taken from another roll than the one shown; a result not taken off by undo; values of squares seen from X when
playing O; an opponent that takes any square.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from backgammon_slowly import row

pytest.importorskip("starlette", reason="the extra web is not installed")
pytest.importorskip("httpx", reason="starlette's test client needs httpx")
from starlette.testclient import TestClient

from neuralq.apps.cli import main, play
from neuralq.apps.web import play_app
from neuralq.apps.web.play import Gone, Seats
from neuralq.apps.web.play_backgammon import backgammon
from neuralq.apps.web.play_tictactoe import tictactoe
from neuralq.systems.backgammon import BackgammonAgent, ValueNetwork
from neuralq_envs.backgammon import Position

# ---- backgammon at its seats


@pytest.fixture(scope="module")
def agent() -> BackgammonAgent:
    return BackgammonAgent(ValueNetwork.drawn(40, 4, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def client(agent: BackgammonAgent) -> Iterator[TestClient]:
    with TestClient(play_app(backgammon(agent)), base_url="http://127.0.0.1:8765") as one:
        yield one


def post(client: TestClient, name: str, status: int = 200, **fields: Any) -> Any:
    reply = client.post(f"/api/{name}", json=fields)
    assert reply.status_code == status, reply.text
    return reply.json()


def act(client: TestClient, state: dict[str, Any], name: str, **fields: Any) -> Any:
    return post(client, name, seat=state["seat"], revision=state["revision"], **fields)


def played(client: TestClient, state: dict[str, Any], rng: np.random.Generator) -> Any:
    """After a turn of random legal moves, some of which are taken back."""
    while not state["complete"]:
        before = state
        source = str(rng.choice(list(state["moves"])))
        target = int(rng.choice(state["moves"][source]))
        state = act(client, state, "move", source=int(source), target=target)
        assert [state["board"][who]["off"] + state["board"][who]["bar"] + sum(state["board"][who]["points"])
                for who in ("you", "agent")] == [15, 15]  # fmt: skip
        if rng.random() < 0.1:
            state = act(client, state, "undo")
            kept = before.keys() - {"revision", "steps", "before"}
            assert {name: state[name] for name in kept} == {name: before[name] for name in kept}
    return act(client, state, "confirm")


def test_a_game_is_played_to_its_end_and_counted(client: TestClient, agent: BackgammonAgent) -> None:
    rng = np.random.default_rng(1)
    state = post(client, "start", seed=4)
    seat, num_turns = state["seat"], 0
    while state["result"] is None:
        turn, board = state["agent_turn"], state["before"]
        if turn is not None and num_turns < 10:
            # What the agent did is what the agent, asked by itself, thinks best.
            own = [*board["agent"]["points"][::-1], board["agent"]["bar"]]
            other = [*board["you"]["points"], board["you"]["bar"]]
            position = Position(bytes(own), bytes(other), 1)
            after = agent.best_move(position, turn["dice"])
            ranked = agent.ranked_turns(position, turn["dice"], 5)
            assert after.own == bytes([*state["board"]["you"]["points"], state["board"]["you"]["bar"]])
            assert [one["equity"] for one in turn["best"]] == [one.equity for one in ranked]
            assert [one["win"] for one in turn["best"]] == [one.chances.win for one in ranked]
        state = played(client, state, rng)
        num_turns += 1
        assert num_turns < 500
    result = state["result"]
    assert state["score"] == {"you": 0, "agent": 0, result["winner"]: result["points"]}
    assert state["board"][result["winner"]]["off"] == 15
    assert post(client, "move", 422, seat=seat, revision=state["revision"], source=6, target=5)["error"].startswith(
        "the game is over"
    )
    again = act(client, state, "new")
    assert again["score"] == state["score"] and again["result"] is None and again["num_games"] == 2


def test_seeds_decide_the_dice_and_the_first_roll_is_no_double(client: TestClient) -> None:
    openings = []
    for seed in range(30):
        first, second = post(client, "start", seed=seed), post(client, "start", seed=seed)
        assert {**first, "seat": ""} == {**second, "seat": ""} and first["seat"] != second["seat"]
        turn = first["agent_turn"]
        opening = [die["value"] for die in first["dice"]] if turn is None else turn["dice"]
        assert opening[0] > opening[1]
        openings.append((turn is None, *opening))
    assert len(set(openings)) > 10 and {opening[0] for opening in openings} == {True, False}


def test_seats_do_not_see_each_other(client: TestClient) -> None:
    here = post(client, "start", position="4HPwATDgc/ABMA", dice=[3, 1])
    there = post(client, "start", position="4HPwATDgc/ABMA", dice=[3, 1])
    moved = act(client, here, "move", source=8, target=5)
    assert moved["dice"] == [{"value": 3, "used": True}, {"value": 1, "used": False}]
    assert post(client, "state", seat=there["seat"]) == there
    assert act(client, there, "move", source=6, target=5)["board"] != moved["board"]


def test_an_old_revision_is_told_so_and_changes_nothing(client: TestClient) -> None:
    first = post(client, "start", position="4HPwATDgc/ABMA", dice=[3, 1])
    moved = act(client, first, "move", source=8, target=5)
    for name, fields in (("move", {"source": 6, "target": 5}), ("undo", {}), ("confirm", {}), ("new", {})):
        refused = post(client, name, 409, seat=first["seat"], revision=first["revision"], **fields)
        assert "gone on meanwhile" in refused["error"]
    assert post(client, "state", seat=first["seat"]) == moved


def test_a_seat_that_is_not_there_is_not_found() -> None:
    seats = Seats(tictactoe(), most=2)
    tokens = [seats.start({})["seat"] for _ in range(2)]
    seats.act("state", {"seat": tokens[0]})  # so that the other one was left alone longest
    seats.start({})
    assert seats.act("state", {"seat": tokens[0]})["player"] == "X"
    for token in (tokens[1], "", None, 7, ["x"]):
        with pytest.raises(Gone, match="no such game"):
            seats.act("state", {"seat": token})


OPENING = {"position": "4HPwATDgc/ABMA", "dice": [3, 1]}


@pytest.mark.parametrize(
    ("name", "fields", "says"),
    [
        ("move", {"source": 24, "target": 19}, "24/19 is not legal: the other side holds point 19"),
        ("move", {"source": 12, "target": 9}, "no checker of yours is on point 12"),
        ("move", {"source": 6}, "target must be a whole number from 0 to 24, got nothing"),
        ("move", {"source": "6", "target": 5}, "source must be a whole number from 1 to 25, got 6"),
        ("move", {"source": True, "target": 0}, "source must be a whole number"),
        ("move", {"source": 26, "target": 5}, "source must be a whole number from 1 to 25, got 26"),
        ("move", {"source": 10**30, "target": 5}, "source must be a whole number"),
        ("move", {"source": 6, "target": 5, "die": 1}, "there is no field 'die'; there are seat, revision, source"),
        ("move", {"source": 6, "target": 5, "revision": "1"}, "revision must be a whole number"),
        ("undo", {}, "nothing to take back"),
        ("confirm", {}, "the turn is not complete: 3, 1 can still be played"),
        ("new", {"position": "nonsense"}, "a position ID must be 14 characters"),
        ("new", {"position": 3}, "position must be a position ID"),
        ("new", {"position": "4" * 500}, "position must be a position ID"),
        ("new", {"dice": [3, 1]}, "dice can be chosen only with a position"),
        ("new", {**OPENING, "dice": [3, 7]}, "dice must be two whole numbers of 1 to 6, got [3, 7]"),
        ("new", {**OPENING, "dice": [3, 1, 1]}, "dice must be two"),
        ("new", {**OPENING, "dice": "31"}, "dice must be two"),
        ("new", {"position": "4OfBBwAAAAAAAA"}, "the game is over in position"),
        ("new", {"position": "//////////////"}, "a position ID must be 14 characters"),
        ("start", {"seed": -1}, "seed must be a whole number from 0 to 4294967295, got -1"),
        ("start", {"seed": 0.5}, "seed must be a whole number"),
        ("start", {"surprise": 1}, "there is no field 'surprise'; there are seed, position, dice"),
    ],
)
def test_what_makes_no_sense_is_refused_and_changes_nothing(
    client: TestClient, name: str, fields: dict[str, Any], says: str
) -> None:
    state = post(client, "start", **OPENING)
    seated = {} if name == "start" else {"seat": state["seat"], "revision": state["revision"]}
    error = post(client, name, 422, **{**seated, **fields})["error"]
    assert says in error and len(error) < 400
    assert post(client, "state", seat=state["seat"]) == state


def test_the_shell_refuses_what_is_foreign_or_no_json(client: TestClient) -> None:
    assert client.get("/", headers={"host": "evil.example"}).status_code == 400
    assert client.get("/", headers={"host": "localhost:1"}).status_code == 200
    assert client.post("/api/start", content=b"{}", headers={"content-type": "text/plain"}).status_code == 415
    as_json = {"content-type": "application/json"}
    assert client.post("/api/start", content=b"[1]", headers=as_json).status_code == 400
    assert client.post("/api/start", content=b"{" + b" " * 20_000 + b"}", headers=as_json).status_code == 413
    assert client.get("/api/start").status_code == 405
    assert client.post("/api/cheat", json={}).status_code == 404
    assert post(client, "move", 404, seat="nobody's", revision=1, source=6, target=5)["error"].startswith("there is no")
    for path in ("/static/../play.py", "/static/%2e%2e/style.css", "/static/"):
        assert client.get(path).status_code == 404
    assert "default-src 'none'" in client.get("/").headers["content-security-policy"]


def test_the_pages_name_nothing_outside(client: TestClient) -> None:
    noughts = TestClient(play_app(tictactoe()), base_url="http://127.0.0.1")
    for path in ("/", "/static/backgammon.js", "/static/board.js", "/static/seat.js", "/static/turns.js",
                 "/static/play.css", "/static/tictactoe.js", "/static/tictactoe.css", "/static/checkers.js",
                 "/static/checkers.css"):  # fmt: skip
        for reply in (client.get(path), noughts.get(path)):
            assert reply.status_code == 200
            assert "//" not in reply.text.replace("http://www.w3.org/2000/svg", "").replace("// ", ""), path


def position_id(own: dict[int, int], other: dict[int, int]) -> str:
    return Position(row(own), row(other)).gnubg_id


def test_who_cannot_move_passes(client: TestClient) -> None:
    home = {1: 2, 2: 2, 3: 2, 4: 2, 5: 2, 6: 2, 8: 3}
    state = post(client, "start", position=position_id({25: 1, 6: 14}, home), dice=[6, 6])
    assert state["no_move"] and state["complete"] and not state["moves"] and not state["can_undo"]
    state = act(client, state, "confirm")
    assert state["record"][0] == {"who": "you", "dice": [6, 6], "text": "no move", "rank": 1, "loss": 0.0}
    assert len(state["record"]) == 2


@pytest.mark.parametrize(
    ("other", "kind", "points"), [({6: 14}, "game", 1), ({6: 15}, "gammon", 2), ({6: 14, 23: 1}, "backgammon", 3)]
)
def test_the_last_checker_wins_what_is_due(client: TestClient, other: dict[int, int], kind: str, points: int) -> None:
    state = post(client, "start", position=position_id({1: 1}, other), dice=[6, 5])
    state = act(client, state, "move", source=1, target=0)
    assert state["complete"] and state["dice"] == [{"value": 6, "used": False}, {"value": 5, "used": True}]
    state = act(client, state, "confirm")
    assert state["result"] == {"winner": "you", "points": points, "kind": kind}
    assert state["score"] == {"you": 0, "agent": 0}  # for it was set up
    assert state["record"] == [{"who": "you", "dice": [6, 5], "text": "1/off", "rank": 1, "loss": 0.0}]


def test_the_agent_can_win(client: TestClient) -> None:
    state = post(client, "start", position=position_id({23: 2, 6: 13}, {1: 1}), dice=[6, 5])
    while not state["complete"]:
        source = next(iter(state["moves"]))
        state = act(client, state, "move", source=int(source), target=state["moves"][source][0])
    state = act(client, state, "confirm")
    assert state["result"]["winner"] == "agent" and state["result"]["points"] >= 2
    assert state["agent_turn"]["text"] == "1/off" and state["agent_turn"]["best"][0]["equity"] >= 2


def test_hints_are_the_agents_ranking_of_the_visitors_roll(client: TestClient, agent: BackgammonAgent) -> None:
    state = post(client, "start", **OPENING)
    state = act(client, state, "move", source=8, target=5)  # hints are from the start of the turn all the same
    hint = post(client, "hint", seat=state["seat"])
    ranked = agent.ranked_turns(Position.initial(), (3, 1))
    assert hint["num_turns"] == len(ranked) == 16
    assert [one["equity"] for one in hint["best"]] == [one.equity for one in ranked[:5]]
    assert [one["lost_gammon"] for one in hint["best"]] == [one.chances.lost_gammon for one in ranked[:5]]
    state = act(client, act(client, state, "move", source=6, target=5), "confirm")
    made = Position.from_gnubg_id("sGfwATDgc/ABMA")  # after 8/5 6/5
    rank = [one.position for one in ranked].index(made)
    assert state["record"][0]["rank"] == rank + 1 and state["record"][0]["text"] == "8/5 6/5"
    assert state["record"][0]["loss"] == pytest.approx(ranked[0].equity - ranked[rank].equity)


def test_the_position_in_words(client: TestClient) -> None:
    state = post(client, "start", position=position_id({25: 2, 6: 3}, {1: 2, 25: 1}), dice=[6, 6])
    assert state["words"] == (
        "You have 68 pips: 2 on the bar, 3 on 6, 10 off. The agent has 27 pips: 1 on the bar, 2 on 24, 12 off."
    )


# ---- tic-tac-toe


@cache
def outcome(cells: str, player: str) -> int:
    """1, 0 or −1 for ``player``, who is X or O, if nobody errs from here."""
    for a, b, c in ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6)):
        if cells[a] == cells[b] == cells[c] != ".":
            return 1 if cells[a] == player else -1
    if "." not in cells:
        return 0
    mover = "X" if cells.count("X") == cells.count("O") else "O"
    ways = [outcome(cells[:i] + mover + cells[i + 1 :], player) for i in range(9) if cells[i] == "."]
    return max(ways) if mover == player else min(ways)


@pytest.mark.parametrize("player", ["X", "O"])
def test_every_value_is_exact_and_nobody_wins(player: str) -> None:
    rng = np.random.default_rng(3)
    seats = Seats(tictactoe())
    state = seats.start({"player": player, "seed": 5})
    words, games = {1: "win", 0: "draw", -1: "loss"}, {"you": 0, "draws": 0, "opponent": 0}
    for _ in range(60):
        while state["result"] is None:
            cells = "".join(sign or "." for sign in state["cells"])
            marked = [cells[:i] + player + cells[i + 1 :] if cells[i] == "." else None for i in range(9)]
            assert state["values"] == [None if one is None else words[outcome(one, player)] for one in marked]
            before = state
            cell = int(rng.choice([i for i in range(9) if cells[i] == "."]))
            state = doing(seats, state, "move", cell=cell)
            if rng.random() < 0.2:
                state = doing(seats, state, "undo")
                assert {**state, "revision": 0} == {**before, "revision": 0}
        games[state["result"]["winner"] or "draws"] += 1
        assert state["score"] == games
        state = doing(seats, state, "new", player=player)
    assert games["you"] == 0 and games["draws"] > 0 and games["opponent"] > 0


def doing(seats: Seats, state: dict[str, Any], name: str, **fields: Any) -> dict[str, Any]:
    return seats.act(name, {"seat": state["seat"], "revision": state["revision"], **fields})


def test_squares_that_cannot_be_taken_are_refused() -> None:
    with TestClient(play_app(tictactoe()), base_url="http://127.0.0.1") as client:
        state = post(client, "start")
        for cell, says in ((9, "cell must be a whole number from 0 to 8, got 9"), (None, "got nothing")):
            assert says in post(client, "move", 422, seat=state["seat"], revision=1, cell=cell)["error"]
        assert "player must be one of X, O, got Z" in post(client, "start", 422, player="Z")["error"]
        assert "nothing to take back" in post(client, "undo", 422, seat=state["seat"], revision=1)["error"]
        moved = act(client, state, "move", cell=4)
        assert "cell 4 is taken by X" in post(
            client, "move", 422, seat=state["seat"], revision=moved["revision"], cell=4
        )["error"]  # fmt: skip


# ---- the command


def run(argv: list[str]) -> int:
    try:
        return main(["play", *argv])
    except SystemExit as ended:
        return int(ended.code or 0)


def test_what_the_command_does_not_understand(capsys: pytest.CaptureFixture[str]) -> None:
    for argv, says in (
        ([], "GAME"),
        (["chess"], "chess"),
        (["tictactoe", "--agent", "x"], "--agent is for backgammon"),
        (["checkers", "--agent", "x"], "--agent is for backgammon; checkers is played by the weights shipped"),
        (["tictactoe", "--plies", "2"], "--plies is for backgammon and checkers"),
        (["backgammon", "--plies", "3"], "--plies must lie in 1..2 for backgammon, got 3"),
        (["checkers", "--plies", "1"], "--plies must lie in 2..11 for checkers, got 1"),
        (["backgammon", "--port", "70000"], "--port must lie in 0..65535"),
    ):
        assert run(argv) == 2
        assert says in capsys.readouterr().err


def test_a_missing_agent_says_how_to_train_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["backgammon", "--agent", "/nowhere/weights.safetensors", "--no-browser"]) == 1
    said = capsys.readouterr().err
    assert "/nowhere/weights.safetensors" in said and "neuralq train td-gammon" in said


def test_the_command_serves_the_game_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    from neuralq.apps.web import server

    served = []

    def serve_app(make: Any, host: str, port: int, title: str, *, open_browser: bool, announce: Any) -> None:
        served.append((title, host, port, open_browser, [route.path for route in make().routes]))
        if announce is not None:
            announce("http://127.0.0.1:1234/")

    monkeypatch.setattr(server, "serve_app", serve_app)
    weights = tmp_path / "weights.safetensors"
    ValueNetwork.drawn(40, 4, np.random.default_rng(0)).save(weights)
    assert play.play(["tictactoe", "--no-browser", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"game": "tictactoe", "url": "http://127.0.0.1:1234/"}
    assert play.play(["backgammon", "--agent", str(weights), "--port", "8000"]) == 0
    assert [one[:4] for one in served] == [
        ("Tic-tac-toe", "127.0.0.1", 0, False), ("Backgammon", "127.0.0.1", 8000, True),
    ]  # fmt: skip
    assert "/api/undo" in served[0][4] and "/api/confirm" in served[1][4]
