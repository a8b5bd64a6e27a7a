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
    """Where a page's function is, and what it shows in one line."""

    module: str
    function: str
    summary: str


PAGES = {
    "fig-13.2": PageEntry("figures", "figure_13_2", "V* and Q of the small grid world, number by number"),
    "fig-13.3": PageEntry("figures", "figure_13_3", "one update of the table"),
    "table-13.1": PageEntry("learning", "table_13_1", "Q-learning in a deterministic world; k to the power Q"),
    "ex-13.1": PageEntry("figures", "exercise_13_1", "every optimal policy of the small grid world"),
    "ex-13.2": PageEntry("exercises", "exercise_13_2", "a grid solved, changed and learned episode by episode"),
    "ex-13.3": PageEntry("tic_tac_toe", "exercise_13_3", "tic-tac-toe against one opponent, then another"),
    "ex-13.4": PageEntry("exercises", "exercise_13_4", "one policy is best from every start"),
    "order": PageEntry("ordering", "update_order", "an episode updated forwards and backwards"),
    "replay": PageEntry("ordering", "replaying", "stored transitions learned again"),
    "dyna": PageEntry("models", "dyna_maze", "imagined moves between the real ones"),
    "sweeping": PageEntry("models", "sweeping", "planning where the table is most wrong"),
    "td-lambda": PageEntry("prediction", "lambda_recursion", "Q^λ as a sum and as a recursion"),
    "random-walk": PageEntry("prediction", "random_walk_page", "TD(λ) on Sutton's random walk"),
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
