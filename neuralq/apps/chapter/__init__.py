"""Mitchell 1997, chapter 13, as pages that run: each figure, table and exercise beside the printed numbers."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from neuralq.checks import check_choice

if TYPE_CHECKING:
    from neuralq.runs.report.claims import ChapterPage

__all__ = ["PAGES", "PageEntry", "run_page"]


class PageEntry(NamedTuple):
    """Where a page's function is, what it shows in one line, in which section, and CPU-seconds that it takes."""

    module: str
    function: str
    summary: str
    section: str
    seconds: int = 0


PAGES = {
    "fig-13.2": PageEntry("figures", "figure_13_2", "V* and Q of the small grid world, number by number", "13.2", 1),
    "fig-13.3": PageEntry("figures", "figure_13_3", "one update of the table", "13.3.2"),
    "table-13.1": PageEntry("learning", "table_13_1", "Q-learning in a deterministic world; k to the power Q", "13.3"),
    "ex-13.1": PageEntry("figures", "exercise_13_1", "every optimal policy of the small grid world", "13.2"),
    "ex-13.2": PageEntry("exercises", "exercise_13_2", "a grid solved, changed and learned episode by episode", "13.3"),
    "ex-13.3": PageEntry("tic_tac_toe", "exercise_13_3", "tic-tac-toe against one opponent, then another", "13.3", 1),
    "ex-13.4": PageEntry("exercises", "exercise_13_4", "one policy is best from every start", "13.2", 2),
    "order": PageEntry("ordering", "update_order", "an episode updated forwards and backwards", "13.3.6"),
    "replay": PageEntry("ordering", "replaying", "stored transitions learned again", "13.3.6"),
    "dyna": PageEntry("models", "dyna_maze", "imagined moves between the real ones", "13.3.6", 2),
    "sweeping": PageEntry("models", "sweeping", "planning where the table is most wrong", "13.3.6", 2),
    "td-lambda": PageEntry("prediction", "lambda_recursion", "Q^λ as a sum and as a recursion", "13.5"),
    "random-walk": PageEntry("prediction", "random_walk_page", "TD(λ) on Sutton's random walk", "13.5", 2),
}


def run_page(name: str) -> ChapterPage:
    """The result of a page.

    Raises:
        ValueError: no page of that name.

    Example:
        >>> run_page("fig-13.3").reproduced
        True
    """
    check_choice("page", name, PAGES)
    entry = PAGES[name]
    page: Callable[[], ChapterPage] = getattr(
        importlib.import_module(f"neuralq.apps.chapter.{entry.module}"), entry.function
    )
    return page()
