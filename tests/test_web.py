"""The lab's page: its answers against known numbers, its refusals, and the page itself in headless Chromium.

Mutants that die: the host check left out, or comparing with the port; the size of the body checked by its declared
length only; booleans taken for numbers; NaN let through; the answer of an older question shown after a newer one
(`round` not looked at); γ of the request not handed on; a worker that is not ended at the deadline.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import re
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any

import pytest

from neuralq.apps.web import lab_app, serve, server
from neuralq.apps.web.catalogue import field_of
from neuralq.checks import MissingExtra
from neuralq.lab.methods import METHODS
from neuralq.lab.problems import PROBLEMS

pytest.importorskip("starlette", reason="the extra web is not installed")
pytest.importorskip("httpx", reason="starlette's test client needs httpx")
from starlette.testclient import TestClient

from neuralq.apps.web.play_tictactoe import tictactoe
from neuralq.apps.web.pool import Left, Pool, TooLong

STAR = {"problem": "baird", "gamma": 0.99, "step_size": 0.01, "method": "td", "sampling": "expected", "options": {}}
PLACE = {name: STAR[name] for name in ("problem", "gamma", "step_size")}


@pytest.fixture(scope="module")
def client() -> Iterator[TestClient]:
    with TestClient(lab_app(), base_url="http://127.0.0.1:8765") as one:
        yield one


def ask(client: TestClient, kind: str, **changes: Any) -> Any:
    reply = client.post(f"/api/{kind}", json={**STAR, **changes})
    assert reply.status_code == 200, reply.text
    return reply.json()


# ---- answers


def test_the_star_turns_at_15_over_17(client: TestClient) -> None:
    # (n + 9)/(2n + 5) with n = 6 upper states, in the limit of small steps.
    for off, verdict in ((1e-3, "diverges"), (-1e-3, "converges")):
        assert ask(client, "diagnose", gamma=15 / 17 + off, step_size=1e-4)["verdict"] == verdict
    limit = ask(client, "critical", parameter="gamma")["limit"]
    assert limit["boundaries"] == [pytest.approx(15 / 17, rel=1e-9)]


@pytest.mark.parametrize(
    ("verdict", "changes"),
    [
        ("diverges", {}),
        ("converges", {"options": {"lambda_": 1.0}}),
        ("mean-stable but variance diverges", {"gamma": 0.88, "sampling": "markov"}),
        ("stable but poor fixed point", {"problem": "kolter", "method": "naive-residual", "step_size": 0.1}),
        ("chatters", {"problem": "chattering", "gamma": 0.9, "method": "sarsa"}),
        ("neutral", {"problem": "baird-control", "method": "sarsa"}),
    ],
)
def test_every_verdict_is_reached(client: TestClient, verdict: str, changes: dict[str, Any]) -> None:
    found = ask(client, "diagnose", **changes)
    assert found["verdict"] == verdict
    assert found["explanation"].endswith(".")
    assert max(abs(complex(*one)) for one in found["eigenvalues"]) == pytest.approx(found["spectral_radius"], rel=1e-9)


def test_a_run_says_what_figure_11_2_shows(client: TestClient) -> None:
    # Sutton & Barto 2018, figure 11.2: an independent float64 iteration of the expected update gives RMSVE 581.355
    # after 1000 sweeps, from w = (1, 1, 1, 1, 1, 1, 10, 1).
    went = ask(client, "run", num_steps=1000, num_seeds=20)
    assert went["steps"][-1] == 1000 and went["num_seeds"] == 1
    assert went["rmsve"][1][-1] == pytest.approx(581.355, abs=1e-3)
    assert [row[0] for row in went["weights"]] == [1, 1, 1, 1, 1, 1, 10, 1]
    assert all(len(row) == len(went["steps"]) for row in [*went["weights"], *went["rmsve"], went["rmspbe"]])


def test_a_run_that_leaves_every_bound_has_no_infinity(client: TestClient) -> None:
    went = ask(client, "run", step_size=1000.0, sampling="markov", num_steps=500, num_seeds=3)
    assert went["num_diverged"] == 3


def test_a_bound_without_end_is_said_in_words(client: TestClient) -> None:
    found = ask(client, "diagnose", method="lstd")
    assert found["step_size_bound"] == {"value": None, "every": True}


def test_the_edge_of_a_step_size_is_its_bound(client: TestClient) -> None:
    # A table on-policy: w ← w + α D (γP − I) w; one state with D = 1/7 and γ → 0 gives 1 − α/7, so α < 14 / (1 + γ).
    found = ask(client, "critical", problem="baird-tabular", parameter="step_size", gamma=0.0)
    assert found["bound"]["value"] == pytest.approx(14.0, rel=1e-6)


def test_remedies_can_be_tried(client: TestClient) -> None:
    reply = client.post("/api/prescribe", json={"problem": "w2w", "gamma": 0.99, "step_size": 0.1})
    remedies = reply.json()["remedies"]
    assert {"lambda_", "phi"} <= {one["kind"] for one in remedies}
    for one in [one for one in remedies if one["method"] is not None][:3]:
        again = ask(client, "diagnose", **{**PLACE, "problem": "w2w", "step_size": one["step_size"]},
                    method=one["method"], options=one["options"])  # fmt: skip
        assert again["verdict"] == one["verdict"] and again["converges"]


def test_everything_on_offer_is_accepted(client: TestClient) -> None:
    offered = client.get("/api/lab").json()
    assert [one["name"] for one in offered["problems"]] == [entry.name for entry in PROBLEMS]
    assert [one["name"] for one in offered["methods"]] == [one.name for one in METHODS if one.expected is not None]
    for one in METHODS:
        for option, value in one.defaults.items():
            assert field_of(one, option).accepts(value), (one.name, option)


# ---- refusals


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"problem": "nonsense"}, "problem must be one of baird"),
        ({"problem": ["baird"]}, "problem must be one of"),
        ({"method": "nonsense"}, "method must be one of td"),
        ({"sampling": "often"}, "sampling must be one of expected"),
        ({"gamma": 1.01}, "gamma must be a number from 0 to 1, got 1.01"),
        ({"gamma": "0.9"}, "gamma must be"),
        ({"gamma": True}, "gamma must be"),
        ({"gamma": None}, "got nothing"),
        ({"gamma": 10**400}, "gamma must be"),
        ({"step_size": 0}, "step_size must be"),
        ({"step_size": -0.1}, "step_size must be"),
        ({"options": {"phi": 0.5}}, "no option 'phi'"),
        ({"options": {"lambda_": 2}}, "lambda_ must be"),
        ({"options": {"lambda_": [0]}}, "lambda_ must be"),
        ({"options": 3}, "options must be an object"),
        ({"method": "n-step", "options": {"num_steps": 1.5}}, "a whole number from 1 to 256"),
        ({"num_steps": 20_001}, "num_steps must be a whole number from 1 to 20000"),
        ({"num_steps": 10.5}, "num_steps must be"),
        ({"num_seeds": 51}, "num_seeds must be"),
        ({"surprise": 1}, "there is no field 'surprise'"),
        ({"problem": "baird", "method": "q-learning"}, "state"),  # values of states, a method for pairs
        ({"gamma": 1.0}, "γ = 1"),
        ({"problem": "spiral", "gamma": 0.9}, "not linear"),
    ],
)
def test_what_makes_no_sense_is_refused_with_a_reason(
    client: TestClient, changes: dict[str, Any], says: str
) -> None:  # fmt: skip
    reply = client.post("/api/run", json={**STAR, "num_steps": 10, "num_seeds": 1, **changes})
    assert reply.status_code == 422, reply.text
    assert says in reply.json()["error"]
    assert len(reply.json()["error"]) < 1000


@pytest.mark.parametrize(
    "body",
    [
        *(b"", b"{", b"[1]", b"null", b"3", b'"x"', b"\xff\xfe", b'{"gamma": NaN}', b'{"gamma": Infinity}'),
        *(b"[" * 9000, b'{"a":' * 1900, b"9" * 9000, b'{"gamma": 1, "gamma": 2}'),
    ],
)
def test_what_is_no_object_is_refused(client: TestClient, body: bytes) -> None:
    reply = client.post("/api/diagnose", content=body, headers={"content-type": "application/json"})
    assert reply.status_code == 400, reply.text
    assert "JSON object" in reply.json()["error"]


def test_a_number_that_overflows_is_refused(client: TestClient) -> None:
    body = json.dumps(STAR).replace("0.99", "1e999")
    reply = client.post("/api/diagnose", content=body, headers={"content-type": "application/json"})
    assert reply.status_code == 422 and "gamma must be" in reply.json()["error"]


def test_a_body_too_large_is_refused_whether_it_says_so_or_not(client: TestClient) -> None:
    huge = b'{"problem": "' + b"x" * 20_000 + b'"}'
    json_type = {"content-type": "application/json"}
    assert client.post("/api/diagnose", content=huge, headers=json_type).status_code == 413
    pieces = (huge[at : at + 1000] for at in range(0, len(huge), 1000))  # sent in chunks, of no declared length
    assert client.post("/api/diagnose", content=pieces, headers=json_type).status_code == 413
    lie = {**json_type, "content-length": "9" * 50}
    assert client.post("/api/diagnose", content=b"{}", headers=lie).status_code == 413


def test_other_content_types_are_refused(client: TestClient) -> None:
    for kind in ("text/plain", "application/x-www-form-urlencoded", ""):
        reply = client.post("/api/diagnose", content=json.dumps(STAR), headers={"content-type": kind})
        assert reply.status_code == 415


def test_other_methods_and_places_are_refused(client: TestClient) -> None:
    assert client.get("/api/diagnose").status_code == 405
    assert client.delete("/").status_code == 405
    assert client.post("/api/nothing", json={}).status_code == 404
    assert client.get("/nothing").json() == {"error": "Not Found"}


@pytest.mark.parametrize(
    "path",
    ["/static/%2e%2e/app.py", "/static/..%2fapp.py", "/static/%2e%2e%2f%2e%2e%2f__init__.py", "/static//etc/passwd",
     "/static/%2fetc%2fpasswd", "/static/..%5capp.py", "/static/", "/static/%00"],
)  # fmt: skip
def test_nothing_outside_the_static_folder_is_served(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8765", "127.0.0.1.evil.example", "", "10.0.0.1", "[::2]", "localhost:x"]
)
def test_foreign_hosts_are_refused(client: TestClient, host: str) -> None:
    assert client.get("/", headers={"host": host}).status_code == 400


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost:8765", "LOCALHOST", "[::1]:8765", "[::1]"])
def test_this_machine_is_answered(client: TestClient, host: str) -> None:
    assert client.get("/", headers={"host": host}).status_code == 200


def test_served_everywhere_it_answers_to_addresses_but_to_no_foreign_name() -> None:
    everywhere = TestClient(lab_app("0.0.0.0"))
    assert everywhere.get("/", headers={"host": "192.168.1.7:8765"}).status_code == 200
    assert everywhere.get("/", headers={"host": "evil.example"}).status_code == 400


def test_every_answer_has_the_headers(client: TestClient) -> None:
    refused = client.get("/", headers={"host": "evil.example"})
    for reply in (client.get("/"), client.get("/plotly.min.js"), client.get("/nothing"), refused):
        policy = reply.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe-eval" not in policy
        assert re.search(r"script-src 'self';", policy)
        assert reply.headers["x-content-type-options"] == "nosniff"


def test_the_page_names_nothing_outside(client: TestClient) -> None:
    for path in (
        "/",
        "/static/style.css",
        "/static/lab.js",
        "/static/charts.js",
        "/static/sliders.js",
        "/static/words.js",
    ):
        text = client.get(path).text
        assert not re.search(r"(https?:)?//[a-z]+\.", text.replace("http://www.w3.org/2000/svg", "")), path


# ---- workers


async def _stays() -> bool:
    return False


async def _leaves() -> bool:
    return True


def test_a_worker_is_ended_when_it_takes_too_long_and_replaced() -> None:
    slow = {**STAR, "method": "gtd2", "sampling": "iid", "options": {"lambda_": 0.0, "beta_over_alpha": 10.0}}

    async def scene() -> None:
        pool = Pool(1, deadline_seconds=0.05)
        await pool.warm()
        (first,) = pool._all
        with pytest.raises(TooLong):
            await pool.ask("diagnose", {**slow, "problem": "baird-control"}, _stays)
        assert await asyncio.wait_for(first.wait(), 10) != 0
        with pytest.raises(Left):
            await pool.ask("diagnose", STAR, _leaves)
        pool.deadline_seconds = 60.0
        status, found = await pool.ask("diagnose", STAR, _stays)
        (second,) = pool._all
        await pool.close()
        assert (status, found["verdict"]) == (200, "diverges")
        assert second is not first and second.returncode is not None

    asyncio.run(scene())


# ---- starting


def test_a_missing_extra_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "uvicorn" else found(name))
    with pytest.raises(MissingExtra, match=r'uvicorn.*pip install "neuralq\[web\]"'):
        serve()


def test_a_public_address_is_warned_about(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(host: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(server, "lab_app", stop)
    with pytest.warns(UserWarning, match="no password"), pytest.raises(KeyboardInterrupt):
        serve("0.0.0.0")
    for private in ("127.0.0.1", "localhost", "::1", "127.8.9.1"):
        with warnings.catch_warnings(), pytest.raises(KeyboardInterrupt):
            warnings.simplefilter("error")
            serve(private)


def test_a_port_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OSError):
        serve(port=taken.getsockname()[1])


# ---- what a server meets that stands open


PAGES = ["lab", "tictactoe"]


@pytest.fixture(scope="module")
def page(client: TestClient) -> Iterator[dict[str, tuple[TestClient, str]]]:
    """A page's client, and a path that takes JSON."""
    with TestClient(server.play_app(tictactoe()), base_url="http://127.0.0.1:8765") as play:
        yield {"lab": (client, "/api/diagnose"), "tictactoe": (play, "/api/start")}


@pytest.mark.parametrize("which", PAGES)
@pytest.mark.parametrize(
    "body",
    [
        '{"problem": "\\ud800"}', '{"\\udfff": 1}', '{"options": {"\\ud83d": 1}}', '{"a": [["x\\ude00y"]]}',
    ],
)  # fmt: skip
def test_half_a_character_is_refused_wherever_it_stands(which: str, body: str, page: Any) -> None:
    client, path = page[which]
    reply = client.post(path, content=body, headers={"content-type": "application/json"})
    assert reply.status_code == 400 and "half a surrogate pair" in reply.json()["error"]
    whole = client.post(path, content='{"problem": "\\ud83d\\ude00"}', headers={"content-type": "application/json"})
    assert whole.status_code == 422, "a pair is a character, which means nothing here"


@pytest.mark.parametrize("which", PAGES)
@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        ("http://127.0.0.1:8765", True), ("https://127.0.0.1:8765", True), (None, True), ("http://evil.example", False),
        ("null", False), ("http://127.0.0.1:8766", False), ("http://127.0.0.1", False),
        ("http://localhost:8765", False),
        ("http://127.0.0.1:8765.evil.example", False), ("", False),
    ],
)  # fmt: skip
def test_pages_of_other_sites_get_no_answer(which: str, origin: str | None, allowed: bool, page: Any) -> None:
    client, path = page[which]
    headers = {} if origin is None else {"origin": origin}
    for reply in (client.post(path, json={"no": "field"}, headers=headers), client.get("/", headers=headers)):
        assert (reply.status_code in (200, 422)) == allowed and (reply.status_code == 403) != allowed


def test_a_request_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("uvicorn")
    from neuralq.apps.web import patience

    monkeypatch.setattr(patience, "PATIENCE_SECONDS", 0.3)
    found: list[str] = []
    serving = {"title": "x", "announce": found.append}
    threading.Thread(
        target=lambda: server.serve_app(lambda: server.play_app(tictactoe()), "127.0.0.1", 0, **serving),  # type: ignore[arg-type]
        daemon=True,
    ).start()
    while not found:
        time.sleep(0.01)
    port = int(found[0].rstrip("/").rpartition(":")[2])
    start = f"POST /api/start HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\ncontent-type: application/json\r\n"
    for sent, more in (
        ("", ""), (start, "x-more: 1\r\n"), (start + "content-length: 99\r\n\r\n{", " "),
        (start + "content-length: 2\r\n\r\n{}GET / HTTP/1.1\r\nhost", "x"),
    ):  # fmt: skip
        with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
            began = time.monotonic()
            connection.sendall(sent.encode())
            connection.settimeout(0.1)
            closed = False
            while not closed and time.monotonic() - began < 3:
                try:
                    closed = connection.recv(4096) == b""
                except TimeoutError:
                    connection.sendall(more.encode())  # a byte now and then
                except ConnectionError:
                    closed = True
            assert closed and time.monotonic() - began < 1.5, (sent, more)
