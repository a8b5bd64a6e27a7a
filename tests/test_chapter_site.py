"""The chapter as a site: a reader who goes from page to page sees all of them, and what was stopped can be read."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from neuralq.apps import chapter
from neuralq.apps.chapter import site
from neuralq.apps.chapter.site import ELSEWHERE, INDEX, SECTIONS, build_site, by_section, section_of
from neuralq.apps.cli import chapter as command
from neuralq.apps.cli import main
from neuralq.runs.report.claims import ChapterPage, Row
from neuralq.systems import SYSTEMS

CHROMIUM = shutil.which("chromium")
FEW = ("littman", "peng-williams")
"""Systems that a minute is enough for, with one seed."""


def small(name: str) -> ChapterPage:
    verdict = "differs" if name == "ex-13.1" else "agrees"
    rows = (Row("a claim", 1.0, 1.0, verdict), Row("another", 2.0, 3.0, "not reproduced"), Row("ours", "", 1.0, "ours"))
    return ChapterPage(name, f"The title of {name}", "13.2", ("A sentence.",), rows)


def test_pages_are_linked_in_the_order_of_sections(tmp_path: Path) -> None:
    names = ["ase-ace", "td-lambda", "fig-13.2", "ex-13.1"]
    made = build_site(tmp_path, names, small, "neuralq chapter --all", clock=iter(range(0, 100, 5)).__next__)
    order = ["fig-13.2", "ex-13.1", "td-lambda", "ase-ace"]
    assert list(made) == order and {path.stem for path in tmp_path.iterdir()} == {*order, "index"}
    index = (tmp_path / INDEX).read_text()
    assert re.findall(r'href="(.*?)\.html"', index) == order
    assert "1 of 2 come out" in index and "wrong: a claim" in index and "still to be made" not in index
    assert index.count("<td>5 s</td>") == 4
    assert all(f"{section} {SECTIONS[section]}" in index for section in SECTIONS)
    for i, name in enumerate(order):
        links = re.findall(r'<a href="(.*?)\.html">', (tmp_path / f"{name}.html").read_text())
        expected = ["index", *order[max(0, i - 1) : i], *order[i + 1 : i + 2]]
        assert links == 2 * expected  # above and below


def test_what_was_made_can_be_read_when_the_rest_was_stopped(tmp_path: Path) -> None:
    def make(name: str) -> ChapterPage:
        if name == "td-lambda":
            raise KeyboardInterrupt
        return small(name)

    with pytest.raises(KeyboardInterrupt):
        build_site(tmp_path, ["fig-13.2", "td-lambda", "ase-ace"], make, "neuralq chapter --all")
    index = (tmp_path / INDEX).read_text()
    assert re.findall(r'href="(.*?)\.html"', index) == ["fig-13.2"] and "2 pages are still to be made" in index


@pytest.mark.whole
def test_every_page_and_system_belongs_to_a_section_that_there_is() -> None:
    names = [*chapter.PAGES, *SYSTEMS]
    assert sorted(name for _, some in by_section(names) for name in some) == sorted(names)
    for name in chapter.PAGES:
        assert chapter.run_page(name).section == chapter.PAGES[name].section or name.startswith("ex-")
    assert all(some or section in ELSEWHERE for section, some in by_section(names))


@pytest.mark.parametrize("section", ["13.4", "13.7"])
def test_commands_of_sections_without_a_page_are_commands(
    section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ELSEWHERE[section].command.split()[1:]
    assert main([*words, *(["--total-steps", "200"] if words[0] == "train" else [])]) == 0


@pytest.mark.parametrize("section", ["13.1", "13.6"])
def test_commands_that_train_for_long_begin(section: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ELSEWHERE[section].command.split()[1:], "--help"]) == 0 and capsys.readouterr().out


def with_few(monkeypatch: pytest.MonkeyPatch, pages: dict[str, Any], systems: dict[str, Any]) -> None:
    for module in (command, site):
        monkeypatch.setattr(module, "PAGES", pages)
        monkeypatch.setattr(module, "SYSTEMS", systems)


def test_a_number_that_must_come_out_and_does_not_ends_with_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_few(monkeypatch, {name: chapter.PAGES[name] for name in ("fig-13.2", "ex-13.1")}, {})
    monkeypatch.setattr(command, "run_page", small)
    assert main(["chapter", "--all", "--html", str(tmp_path / "site"), "--json"]) == 1
    captured = capsys.readouterr()
    found = json.loads(captured.out.splitlines()[-1])
    assert found["pages"]["fig-13.2"]["verdict"] == "1 of 2 come out" and Path(found["index"]).exists()
    assert "not reproduced: ex-13.1 (a claim)" in captured.err


def test_what_does_not_go_with_all_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chapter", "fig-13.2", "--all"]) == 2 and "leave fig-13.2 out" in capsys.readouterr().err
    assert main(["chapter", "--all", "--svg", "x.svg"]) == 2 and "leave --svg out" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["chapter", "--all", "--html", str(tmp_path / "file")]) == 2
    assert "is a file; name a folder" in capsys.readouterr().err


@pytest.mark.whole
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt-get install chromium")
def test_a_reader_walks_through_the_chapter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every figure and exercise and two systems, trained; from the list to the first page and on to the last."""
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    from playwright.sync_api import sync_playwright

    with_few(monkeypatch, dict(chapter.PAGES), {name: SYSTEMS[name] for name in FEW})
    monkeypatch.chdir(tmp_path)
    assert main(["chapter", "--all", "--seeds", "1"]) == 0
    folder = tmp_path / "runs" / "chapter"
    order = [name for _, some in by_section([*chapter.PAGES, *FEW]) for name in some]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 400, "height": 800})
        problems: list[str] = []
        page.on("console", lambda message: problems.append(message.text))
        page.on("requestfailed", lambda request: problems.append(request.url))
        page.goto((folder / INDEX).as_uri())
        titles = [page.title()]
        page.get_by_role("link", name=order[0], exact=True).click()
        for name in order:
            assert page.url.endswith(f"/{name}.html") and page.locator("h1").inner_text()
            assert page.locator("svg").count() >= 1, name
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{name} is wider than a phone"
            titles.append(page.title())
            if name != order[-1]:
                page.get_by_role("link", name="→").first.click()
        assert page.get_by_role("link", name="→").count() == 0
        page.get_by_role("link", name="The chapter").last.click()
        assert page.url.endswith(INDEX) and page.locator(".contents a").count() == len(order)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        browser.close()
    assert not problems and len(set(titles)) == len(order) + 1
    assert section_of(order[0]) == "13.2"
