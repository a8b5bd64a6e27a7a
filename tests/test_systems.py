"""The frame of the chapter's systems, the command that runs them, and what the two on the pole must reach.

A system that is a folder and a line of the table goes through the command as the others do. Mutants that die here: a
contender that is given another seed than its neighbour, results in the order in which they ended, oracle rows lost, an
interval one order statistic too narrow, a claim that does not hold called agreeing, exit status 1 for what was merely
published and 0 for what is exact, a page that loads something, failures of given-up trainings shown as if they were
all.
"""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import scipy.stats
from gymnasium.utils.env_checker import check_env

from neuralq.apps.cli import main
from neuralq.runs.report.claims import Measured
from neuralq.runs.sweep.statistics import median_interval
from neuralq.systems import SYSTEMS, SystemEntry, run_system, system_named
from neuralq.systems.peng_williams import oracle
from neuralq.systems.peng_williams.trials import Settings, film_trials, train
from neuralq_envs.pole_kernels import box_of

Capture = pytest.CaptureFixture[str]

DICE = """
import time
import numpy as np
from neuralq.runs.report.claims import ChapterPage, Measured, Picture, number, own, published
from neuralq.systems import System


rolled = []


def roll(seed, full):
    rolled.append(seed)
    time.sleep(0.2 * (len(rolled) == 1))  # the first one ends after others that began later
    return float(np.random.default_rng(seed).integers(100) + 100 * full)


def page(found, full):
    same = found["dice"] == found["other dice"]
    rows = (published("both roll alike", "they do", "they do" if same else "they do not", same),
            published("a die shows 7", "always", "hardly ever", False, "nobody could"),
            own("size", "full" if full else "small"))
    picture = Picture("A die", "<svg class='figure'></svg>", "what is rolled")
    return ChapterPage("dice", "Dice", "13.8", ("Rolled.", "Again <b>."), rows, (picture,), "Pascal 1654",
                       (Measured("dice", found["dice"]),), {"sides": "100"})


def oracle():
    return (number("opposite sides", 7.0, EXACT),)


EXACT = 7.0
DICE = System("dice", "neuralq/PoleBoxes-v0", "neuralq.tabular:q_lambda", {"dice": roll, "other dice": roll},
              ("other dice",), oracle, page, 7, 9)
"""


@pytest.fixture
def dice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    folder = tmp_path / "dice_system"
    folder.mkdir()
    (folder / "__init__.py").write_text(DICE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(SYSTEMS, "dice", SystemEntry("dice_system:DICE", "two dice", 5))
    monkeypatch.chdir(tmp_path)
    return __import__("dice_system")


def test_a_folder_and_a_line_make_a_system_of_the_command(dice: Any, capsys: Capture) -> None:
    assert main(["chapter"]) == 0 and "  dice            two dice" in capsys.readouterr().out
    assert main(["chapter", "dice", "--json"]) == 0  # although a published claim did not come out
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    seeds = np.random.SeedSequence(0).spawn(7)
    rolled = [float(np.random.default_rng(seed).integers(100)) for seed in seeds]
    assert result["measured"] == [
        {"what": "dice", "values": rolled, "limit": None, "median": np.median(rolled),
         "low": min(rolled), "high": max(rolled)}
    ]  # fmt: skip
    verdicts = {row["what"]: row["verdict"] for row in result["rows"]}
    assert verdicts == {
        "both roll alike": "agrees", "a die shows 7": "not reproduced", "size": "ours", "opposite sides": "agrees"
    }  # fmt: skip
    assert result["reproduced"] is False and result["html"] == "runs/chapter/dice.html"
    assert main(["chapter", "dice", "--full", "--seeds", "2", "--html", "d/p.html"]) == 0
    out = capsys.readouterr().out
    assert "Dice (Mitchell 1997, 13.8; Pascal 1654)" in out and "not reproduced" in out and "page: d/p.html" in out
    page = Path("d/p.html").read_text()
    assert "neuralq chapter dice --full --seeds 2 --html d/p.html" in page and "Again &lt;b&gt;." in page
    for said in ("✗ not reproduced", "nobody could", "what is rolled", "sides", "other dice", "2, the same for every"):
        assert said in page
    assert re.findall(r"(?:src|href|url\()\W*http", page) == [] and "<script" not in page
    Balanced().feed(page)


def test_what_is_exact_and_differs_ends_with_status_1(dice: Any, monkeypatch: Any, capsys: Capture) -> None:
    monkeypatch.setattr(dice, "EXACT", 8.0)
    assert main(["chapter", "dice", "--seeds", "1", "--json"]) == 1
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == "neuralq: dice: not reproduced: opposite sides"
    assert json.loads(captured.out.splitlines()[-1])["measured"][0]["low"] is None  # one seed bounds nothing


class Balanced(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        if tag not in ("meta", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--seeds", "3"], "--seeds and --full are for systems, and nothing is named; the systems are advice, "),
        (["fig-13.2", "--full"], "are for systems, and fig-13.2 is none"),
        (["ase-ace", "--seeds", "0"], "--seeds must be at least 1, got 0"),
        (["ase-ace", "--svg", "x.svg"], "--svg is for figures and exercises; ase-ace writes a page: --html FILE"),
        (["--html", "x.html"], "need a name"),
        (["ase-ace", "--html", "."], "is a folder; name a file: --html FILE"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(argv: list[str], said: str, capsys: Capture) -> None:
    assert main(["chapter", *argv]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1


def test_an_unknown_system_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="'ase-ace', "):
        system_named("elevator")


def test_the_interval_of_a_median_covers_it_as_often_as_it_says() -> None:
    # n = 6: both ends, 1 − 2/2⁶ = .969. n = 20: the 6th from either end (the table of the sign test), .9586.
    assert median_interval(range(6)) == (0, 5) and median_interval(range(5)) is None
    assert median_interval(range(20)) == (5, 14)
    for n in (9, 20, 30, 101):
        low, _ = median_interval(range(n)) or (0, 0)
        k = int(low) + 1
        missed = [2 * scipy.stats.binomtest(j, n).pvalue / 2 for j in (k - 1, k)]
        assert missed[0] <= 0.05 < missed[1]
    with pytest.raises(ValueError, match="at least one score"):
        median_interval([])


def test_what_was_given_up_is_said_to_be_more() -> None:
    assert str(Measured("f", (10, 10, 10, 10, 10, 10), 10)) == "over 10"
    assert str(Measured("f", (3, 10), 10)) == "6.5 (2 seeds: 3 to over 10)"


LONG = {"checkers", "elevators", "job-shop"}
"""Systems whose kernels take more than ten seconds to compile."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else pytest.mark.whole) for name in SYSTEMS]
)
def test_a_system_is_what_it_says(name: str) -> None:
    system = system_named(name)
    assert system.name == name and system.num_seeds <= system.full_num_seeds
    check_env(gymnasium.make(system.environment).unwrapped)
    module, _, rule = system.learner.partition(":")
    assert callable(getattr(__import__(module, fromlist=[rule]), rule))
    assert [row.verdict for row in system.oracle()] == ["agrees"] * len(system.oracle())


@pytest.mark.whole
def test_the_ends_of_q_lambda() -> None:
    plain, lengths = oracle.one_step_training(5, 25)
    ours = train(5, Settings(0.0, most_failures=25))
    assert np.array_equal(ours.q, plain) and np.array_equal(ours.lengths, lengths)
    assert not np.array_equal(train(5, Settings(0.1, most_failures=25)).q, plain)
    assert oracle.monte_carlo_difference(num_states=30, alpha=0.7, gamma=0.99, seed=3) < 1e-12


@pytest.mark.whole
def test_a_film_of_q_lambda_is_of_its_own_trial() -> None:
    ours = train(2, Settings(0.9, most_failures=9))
    (film,) = film_trials(ours, [8], 10_000)
    assert len(film) == ours.lengths[8] and (np.abs(film[0]) <= 0.05).all() and film[0].all()
    assert len({box_of(*state) for state in film.tolist()}) > 3
    with pytest.raises(ValueError, match="lambda_ must lie in"):
        Settings(1.5)


# ----------------------------------------------------------------------------------- what they must reach, and must not


@pytest.mark.slow
def test_ase_ace_balances_the_pole_and_the_ase_alone_does_not() -> None:
    found = run_system(system_named("ase-ace"))
    both, _, alone, random = found.measured
    assert len(both.values) == 20 and both.median <= 150
    assert sum(failures <= 300 for failures in both.values) >= 16
    (critic,) = [row for row in found.rows if row.what.startswith("the critic tells more")]
    assert critic.ours == "0 of 20 balance without it, 20 with it"  # beta = 0 is the control that must fail
    assert random.median < alone.median < 150
    assert found.reproduced


@pytest.mark.slow
def test_q_lambda_needs_half_the_failures_of_one_step_q_learning_unless_the_step_is_large() -> None:
    found = run_system(system_named("peng-williams"))
    median = {one.what.partition(":")[0]: one.median for one in found.measured}
    assert len(found.measured[0].values) == 30 and found.reproduced
    assert median["λ = 0.9"] <= 0.5 * median["λ = 0"] and median["λ = 0.5"] <= 0.6 * median["λ = 0"]
    assert median["λ = 0.9, α = 0.5"] > 0.5 * median["λ = 0, α = 0.5"]  # the control that must fail
    assert median["λ = 1"] == 4000  # given up
