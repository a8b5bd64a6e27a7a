"""The pages to play on in headless Chromium: whole games, by mouse and by keyboard alone, on a phone, in the dark.

The agent here only races, so that games are short and the same on every machine; `test_play` looks at the real one.

Mutants that die: the target of a click sent as its source; focus left on a point that can no longer be chosen; undo
that shows the board but leaves the marks; a table of hints that stays when it is switched off.
"""

from __future__ import annotations

import functools
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the extra web is not installed")
pytest.importorskip("uvicorn", reason="the extra web is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
import uvicorn
from playwright.sync_api import sync_playwright

from neuralq.apps.web import play_app
from neuralq.apps.web.play import Offer
from neuralq.apps.web.play_backgammon import BackgammonGame, backgammon
from neuralq.apps.web.play_tictactoe import tictactoe
from neuralq.systems.backgammon import BackgammonAgent, Chances, RankedTurn, ValueNetwork
from neuralq_envs.backgammon import Position

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt-get install chromium")

SOON = 60_000  # milliseconds; the cores are shared
PHONE = {"width": 375, "height": 740}


def race(position: Position, dice: tuple[int, int]) -> list[RankedTurn]:
    """Hits nobody if it can, and leaves few blots."""

    def badness(after: Position) -> tuple[int, int]:
        return after.own[24], list(after.other).count(1)

    ways = sorted(position.afterstates(dice), key=badness)
    return [RankedTurn(after, (after.pips[0] - after.pips[1]) / 100, Chances(0.5, 0.1, 0.1)) for after in ways]


def racing() -> Offer:
    real = backgammon(BackgammonAgent(ValueNetwork(40)))  # its network is never asked
    return Offer(real.page, functools.partial(BackgammonGame, race), real.new, real.actions)


@contextmanager
def served(offer: Offer) -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(uvicorn.Config(play_app(offer), log_level="warning", access_log=False))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}/"
        finally:  # a thread that goes on would keep the tests from ending
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def table() -> Iterator[str]:
    with served(racing()) as address:
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_playwright() as one:
        yield one.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], timeout=SOON)


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A page that must not say anything on the console; checkers do not travel, so that nobody waits for them."""
    with opened(browser, viewport={"width": 1280, "height": 900}) as one:
        yield one


@contextmanager
def opened(browser: Any, **settings: Any) -> Iterator[Any]:
    with browser.new_context(**{"reduced_motion": "reduce", **settings}) as context:
        one = context.new_page()
        one.set_default_timeout(SOON)
        said: list[str] = []
        one.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
        one.on("pageerror", lambda error: said.append(f"error: {error}"))
        yield one
        assert said == []


def revision(page: Any) -> int:
    return int(page.evaluate("document.body.dataset.revision ?? 0"))


def after(page: Any, act: Callable[[], Any]) -> None:
    """Does something and waits for the state that comes of it."""
    before = revision(page)
    act()
    wait_until(lambda: revision(page) > before)


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SOON / 1000
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def spots(page: Any, role: str) -> list[str]:
    found: list[str] = page.evaluate(
        f"[...document.querySelectorAll('.spot.{role}')].map((spot) => spot.dataset.spot)"
    )  # fmt: skip
    return found


def click_spot(page: Any, spot: str) -> None:
    page.click(f'.spot[data-spot="{spot}"]')


def is_over(page: Any) -> bool:
    return bool(page.is_visible("#result"))


def play_to_the_end(page: Any) -> int:
    """By clicks on what is marked, turns being confirmed by themselves; the number of moves."""
    num_moves = 0
    while not is_over(page):
        sources = spots(page, "source") + spots(page, "selected")
        if not sources:  # a turn is being confirmed
            time.sleep(0.005)
            continue
        if not spots(page, "selected"):
            click_spot(page, sources[0])
        after(page, functools.partial(click_spot, page, spots(page, "target")[-1]))
        num_moves += 1
        assert num_moves < 200
    return num_moves


def scores(page: Any) -> list[str]:
    return [page.text_content(f"#{who}-score") for who in ("agent", "your")]


@pytest.mark.slow
def test_a_whole_game_is_played_by_clicking(page: Any, table: str) -> None:
    page.goto(f"{table}?seed=11")
    page.check("#automatic")
    wait_until(lambda: revision(page) > 0)
    assert play_to_the_end(page) > 15
    assert "win" in page.text_content("#result-text") and "point" in page.text_content("#result-text")
    won = scores(page)
    assert sorted(score.split()[0] == "0" for score in won) == [False, True]
    assert page.locator("#record li").count() > 20
    page.uncheck("#automatic")
    after(page, lambda: page.click("#next"))
    assert not is_over(page) and scores(page) == won


@pytest.mark.slow
def test_the_end_of_a_game_is_played_by_clicking(page: Any, table: str) -> None:
    page.goto(f"{table}?seed=11")
    wait_until(lambda: revision(page) > 0)
    page.check("#automatic")
    page.fill(
        "#set-position", Position(bytes([0, 0, 1, 0, 1, 1] + 19 * [0]), bytes([0, 2, 0, 0, 0, 3] + 19 * [0])).gnubg_id
    )
    after(page, lambda: page.click("#set-up button"))
    assert play_to_the_end(page) >= 2
    assert page.text_content("#result-text").endswith("wins the game: 1 point, not counted.") or page.text_content(
        "#result-text"
    ).startswith("You win the game: 1 point")
    assert page.locator("#record li").count() >= 3 and scores(page) == ["0 points", "0 points"]


def test_a_turn_by_keyboard_alone(page: Any, table: str) -> None:
    page.goto(f"{table}?seed=3")
    wait_until(lambda: revision(page) > 0)
    position = page.text_content("#position-id")
    focus = "document.activeElement.dataset.spot ?? document.activeElement.id"
    for _ in range(30):  # Tab reaches what can move, and shows where it is
        page.keyboard.press("Tab")
        if page.evaluate(focus) in spots(page, "source"):
            break
    assert page.evaluate(focus) == spots(page, "source")[0]
    label = page.get_attribute(":focus", "aria-label")
    assert label.endswith("can move") and "of yours" in label
    assert page.evaluate("getComputedStyle(document.activeElement).stroke") != "none"
    seen = set()
    for _ in range(len(spots(page, "source"))):
        page.keyboard.press("ArrowRight")
        seen.add(page.evaluate(focus))
    assert len(seen) > 1 and seen <= set(spots(page, "source"))
    page.keyboard.press("Enter")
    assert page.evaluate(focus) in spots(page, "target") and len(spots(page, "selected")) == 1
    page.keyboard.press("Escape")
    assert spots(page, "target") == [] and page.evaluate(focus) in spots(page, "source")
    page.keyboard.press("Enter")
    after(page, lambda: page.keyboard.press("Space"))
    after(page, lambda: page.keyboard.press("u"))
    assert page.is_disabled("#undo") and page.text_content("#position-id") == position
    while page.is_disabled("#confirm"):
        if not spots(page, "selected"):
            page.keyboard.press("Enter")
        after(page, lambda: page.keyboard.press("Enter"))
    assert page.evaluate(focus) == "confirm"
    assert page.text_content("#status").startswith("Turn played")
    after(page, lambda: page.keyboard.press("Enter"))
    assert page.locator("#record li").count() >= 2
    assert page.text_content("#status").startswith("The agent rolled")
    assert page.evaluate(focus) in {*spots(page, "source"), *spots(page, "target"), "confirm"}
    page.keyboard.press("h")
    page.wait_for_selector("#hint-best table")
    assert 1 <= page.locator("#hint-best tbody tr").count() <= 5
    page.keyboard.press("h")
    wait_until(lambda: page.locator("#hint-best table").count() == 0)


def test_a_position_can_be_set_up_and_what_is_none_is_complained_about(browser: Any, table: str) -> None:
    with browser.new_context(viewport={"width": 1000, "height": 800}, reduced_motion="reduce") as context:
        page = context.new_page()
        page.set_default_timeout(SOON)
        page.goto(table)
        wait_until(lambda: revision(page) > 0)
        page.fill("#set-position", "nonsense<b>")
        page.click("#set-up button")
        page.wait_for_selector("#error:not([hidden])")
        assert "14 characters" in page.text_content("#error") and page.locator("#error b").count() == 0
        page.fill("#set-position", Position(bytes([1] + 24 * [0]), bytes([0] * 5 + [15] + 19 * [0])).gnubg_id)
        page.fill("#set-dice", "6-5")
        after(page, lambda: page.click("#set-up button"))
        assert not page.is_visible("#error")
        click_spot(page, "1")
        after(page, lambda: click_spot(page, "off"))
        after(page, lambda: page.click("#confirm"))
        assert page.text_content("#result-text") == "You win a gammon: 2 points, not counted."
        page.reload()  # the same seat
        page.wait_for_selector("#result:not([hidden])")


def test_the_phone_by_day_and_by_night(browser: Any, table: str) -> None:
    with opened(browser, viewport=PHONE, is_mobile=True, has_touch=True) as page:
        page.goto(f"{table}?seed=5")
        wait_until(lambda: revision(page) > 0)
        page.check("#hints")
        page.wait_for_selector("#hint-best table")
        assert page.evaluate("document.documentElement.scrollWidth") == 375
        page.locator(f'.spot[data-spot="{spots(page, "source")[0]}"]').tap()
        assert spots(page, "target")
        box = page.locator("#confirm").bounding_box()
        assert box["y"] + box["height"] < 740  # board, status and buttons fit one screen
        assert page.locator(".checker .disc").first.bounding_box()["width"] > 33  # px; 23 on a board that lies
        first, last = (page.locator(f'.spot[data-spot="{spot}"]').bounding_box() for spot in ("12", "1"))
        assert first["y"] < last["y"] and first["x"] == pytest.approx(last["x"])  # it stands, home is below
        discs, targets = page.locator(".checker .disc").count(), spots(page, "target")
        page.set_viewport_size({"width": 740, "height": 375})  # the phone is turned: the same board lies
        wait_until(lambda: page.get_attribute("#board", "viewBox") == "0 0 702 580")
        assert page.locator(".checker .disc").count() == discs and spots(page, "target") == targets
        page.set_viewport_size(PHONE)
        papers = set()
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            papers.add(page.evaluate("getComputedStyle(document.body).backgroundColor"))
            for selector in ("#status", "#agent-pips", ".turns td", ".primary"):
                assert page.evaluate(contrast_script(selector)) >= 4.5, (scheme, selector)  # WCAG 2.2, 1.4.3
        assert len(papers) == 2


def contrast_script(selector: str) -> str:
    """The contrast between a text and what is behind it."""
    return f"""(() => {{
      const element = [...document.querySelectorAll("{selector}")].find((one) => !one.disabled);
      if (!element) return 21;
      const back = (at) => {{
        const found = getComputedStyle(at).backgroundColor;
        return found === "rgba(0, 0, 0, 0)" ? back(at.parentElement) : found;
      }};
      const light = (css) => {{
        const [r, g, b] = css.match(/[0-9.]+/g).map((x) => x / 255)
          .map((x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
      }};
      const [low, high] = [getComputedStyle(element).color, back(element)].map(light).sort((a, b) => a - b);
      return (high + 0.05) / (low + 0.05);
    }})()"""


def test_checkers_travel_where_motion_is_wanted(browser: Any, table: str) -> None:
    with opened(browser, reduced_motion="no-preference") as page:
        page.goto(f"{table}?seed=3")
        wait_until(lambda: revision(page) > 0)
        page.evaluate("""(() => {
          const animate = Element.prototype.animate;
          window.travelled = 0;
          Element.prototype.animate = function (...given) { window.travelled += 1; return animate.apply(this, given); };
        })()""")
        click_spot(page, spots(page, "source")[0])
        after(page, lambda: click_spot(page, spots(page, "target")[0]))
        assert page.evaluate("window.travelled") == 1


def test_tic_tac_toe_to_its_end(browser: Any) -> None:
    with served(tictactoe()) as address, opened(browser, viewport=PHONE) as page:
        page.goto(f"{address}?seed=1")
        wait_until(lambda: revision(page) > 0)
        assert page.locator(".value").count() == 0  # nobody is told before he asks
        page.keyboard.press("h")
        assert page.locator(".worth-draw .value.draw").count() == 9  # every opening draws
        assert page.evaluate("document.documentElement.scrollWidth") == 375
        page.keyboard.press("ArrowRight")  # the middle takes the focus
        page.keyboard.press("ArrowUp")
        after(page, lambda: page.keyboard.press("Enter"))
        assert page.locator("[data-cell='1']").get_attribute("aria-label") == "Row 1, column 2, X"
        after(page, lambda: page.click("#as-o"))
        assert page.text_content("#player") == "O" and page.locator("[data-cell] svg").count() == 1
        while not page.text_content("#status").startswith(
            "You lose"
        ):  # what loses is taken: after any opening there is something
            after(page, page.locator("button:has(.value.loss)").first.click)
        assert page.text_content("#status").startswith("You lose")
        assert page.text_content("#score") == "won 0, drawn 0, lost 1" and page.locator(".won").count() == 3
        after(page, lambda: page.keyboard.press("u"))
        assert page.text_content("#score") == "won 0, drawn 0, lost 0"
        page.keyboard.press("h")
        assert page.locator(".value").count() == 0
        after(page, lambda: page.keyboard.press("x"))
        assert page.text_content("#player") == "X" and page.locator("[data-cell] svg").count() == 0
