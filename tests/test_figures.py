"""The numbers of every figure against what is published, hand arithmetic and independent solutions; then the drawing.

Mutants that die: moments that forget where a transition leads; β/α of 11.5 taken as .05; α = 2/λ_max in the hall;
the slowest mode with 2n in place of 2n + 1; the spiral's plane with an axis left out; b/|A|; a greedy where w > 0; φ*
without its γ; λ* with 1 − γg; the glyphs' scale rounded with the places.
"""

from __future__ import annotations

import re
import runpy
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neuralq.lab.figures import FIGURES, Drawing, Panel, Series, png_of, svg_of
from neuralq.lab.figures.cures import (
    figure_critical_curves,
    figure_representations,
    star_critical_lambda,
    star_critical_phi,
)
from neuralq.lab.figures.fitted_grid import figure_fitted
from neuralq.lab.figures.hall import figure_hall, modal_sweeps, predicted_sweeps, sweeps_until
from neuralq.lab.figures.spiral import figure_spiral, spiral_updates
from neuralq.lab.figures.star import figure_11_2, figure_11_5, figure_11_6
from neuralq.lab.figures.states import figure_chattering, figure_kolter
from neuralq_envs.counterexamples import star

SCRIPT = str(Path(__file__).parents[1] / "scripts" / "figures.py")


def at(panel: Panel, label: str, x: float, style: str = "line") -> float:
    """The value of a curve at one of its points."""
    curve = panel.curve(label, style)
    (index,) = np.flatnonzero(np.isclose(curve.x, x))
    return float(curve.y[index])


# --- Sutton & Barto 2018 ----------------------------------------------------------------------------------------------


def test_figure_11_2() -> None:
    """Right: equation 11.9; left: the mean along the chain; both by an independent float64 matrix iteration."""
    left, right = figure_11_2(num_seeds=400).panels
    # sweeps: w1..w6, w7, w8
    published = {100: (3.894886, 9.971199, 9.627054), 500: (26.620084, 9.484751, 76.829754),
                 1000: (114.433716, 6.850030, 335.001209)}  # fmt: skip
    along_chain = {100: (3.885836, 9.969783, 9.597074), 1000: (113.322089, 6.818048, 331.602364)}
    for i, label in enumerate(("w1 to w6 (mean)", "w7", "w8")):
        for sweeps, weights in published.items():
            assert at(right, label, sweeps) == pytest.approx(weights[i], rel=1e-6)
            assert at(right, f"{label}, exact", sweeps, "dashed") == pytest.approx(weights[i], rel=1e-6)
        for updates, weights in along_chain.items():
            assert at(left, f"{label}, exact", updates, "dashed") == pytest.approx(weights[i], rel=1e-6)
        ours = left.curve(label)
        assert ours.low is not None and ours.high is not None
        assert (ours.low <= ours.high).all() and (ours.y[0] == ours.low[0] == ours.high[0])
    # The standard error of w8 from 200,000 runs was .0051 / 4 standard errors at 400 seeds: 4 · .0051 · √500
    assert at(left, "w8", 100) == pytest.approx(9.597074, abs=0.46)


def test_figure_11_5() -> None:
    """RMSVE and RMSPBE of TDC, α = .005, β = .05, by an independent float64 iteration; the book: "almost 2"."""
    left, right = figure_11_5(num_seeds=100).panels
    for style, suffix in (("line", ""), ("dashed", ", exact")):
        for sweeps, error in {100: 3.322961, 200: 2.283301, 500: 1.936275, 1000: 1.935465}.items():
            assert at(right, "√VE" + suffix, sweeps, style) == pytest.approx(error, rel=1e-6)
        assert at(right, "√PBE" + suffix, 1000, style) == pytest.approx(0.00737856, rel=1e-4)
        last = [at(right, label + suffix, 1000, style) for label in ("w1 to w6 (mean)", "w7", "w8")]
        assert last == pytest.approx([2.135314, 6.628051, -2.337956], rel=1e-6)
    assert at(left, "√VE", 0) == pytest.approx(5.318432, rel=1e-6)
    assert at(left, "√PBE", 0) == pytest.approx(8.221408, rel=1e-6)
    for label in ("√VE", "√PBE", "w7", "w8"):
        ours, exact = left.curve(label), left.curve(f"{label}, exact", "dashed")
        off = np.abs(ours.y - exact.y)
        assert ours.high is not None and ours.low is not None
        assert (off <= 4 * (ours.high - ours.low) / 2.56 / np.sqrt(100) + 0.05).all()  # 10-90% is 2.56 deviations wide


def test_figure_11_6() -> None:
    """RMSVE at α = .03 by an independent float64 iteration; both emphases lead to the same weights."""
    left, right = figure_11_6(num_seeds=50).panels
    for sweeps, error in {1: 5.6522, 10: 8.4412, 50: 7.2122, 100: 0.9567, 200: 0.0204}.items():
        assert at(left, "√VE", sweeps) == pytest.approx(error, abs=5.1e-5)
    for label, limit in zip(("w1 to w6 (mean)", "w7", "w8"), 1.692308 * np.array([1, 4, -2]), strict=True):
        assert left.curve(label).y[-1] == pytest.approx(limit, abs=1e-5)
    sampled = right.curve("median of seeds")
    assert sampled.low is not None and sampled.low[-1] > 5.3  # not even the luckiest tenth has come nearer


# --- the others -------------------------------------------------------------------------------------------------------


def test_hall() -> None:
    """Counts by an independent iteration; n² within the tenth that small halls leave."""
    assert [sweeps_until(6, 0.9, name) for name in ("td", "residual")] == [6, 88]
    assert [sweeps_until(n, 1.0, "residual") for n in (12, 24)] == [605, 2349]
    n = 12
    omega = (2 * np.arange(1, n + 1) - 1) * np.pi / (2 * n + 1)
    G = (np.eye(n) - np.eye(n, k=1)).T @ (np.eye(n) - np.eye(n, k=1))
    np.testing.assert_allclose(np.linalg.eigvalsh(G), 2 - 2 * np.cos(omega), atol=1e-12)
    for size in (6, 12, 24):
        assert predicted_sweeps(size) == pytest.approx(sweeps_until(size, 1.0, "residual"), rel=0.01)
        for gamma in (0.9, 1.0):
            assert modal_sweeps(size, gamma) == sweeps_until(size, gamma, "residual")
    one, discounted = figure_hall((6, 48)).panels
    assert one.curve("direct (TD)", "points").y.tolist() == [6, 48]
    assert discounted.curve("direct (TD)", "points").y.tolist() == [6, 44]  # .9⁴⁴ = .0097 is as good as nothing
    assert discounted.curve("n, or 44", "dashed").y.tolist() == [6, 44]
    slope = np.polyfit(np.log([12, 24, 48]), np.log([predicted_sweeps(n) for n in (12, 24, 48)]), 1)[0]
    assert slope == pytest.approx(2, abs=0.05)
    with pytest.raises(ValueError, match="method"):
        sweeps_until(6, 1.0, "lstd")


def test_spiral() -> None:
    """641 and 68 updates until ‖V‖ > 10⁶, and t*, by an independent computation; ‖V‖² e^{−2εθ} = 15800 on the curve."""
    assert [len(spiral_updates(step_size)) - 1 for step_size in (1e-5, 1e-4)] == [641, 68]
    drawing = figure_spiral()
    values, time = drawing.panels
    assert drawing.known["t*"] == pytest.approx(0.006355595572, abs=5e-13)
    path = values.curve("V(θ), closed form", "dashed")
    theta = np.linspace(0, 26, len(path.x))
    np.testing.assert_allclose((path.x**2 + path.y**2) * np.exp(-0.1 * theta), 15800, rtol=1e-9)
    first = values.curve("updates, α = 0.0001", "points")
    assert (first.x[0] * np.sqrt(6), first.y[0] * np.sqrt(2)) == pytest.approx((300, -40))  # of (100, −70, −30)
    closed = time.curve("closed form", "dashed")
    assert np.interp(0.5, closed.x, closed.y) == pytest.approx(10 * np.log(2), rel=1e-3)
    small = time.curve("updates, α = 1e-05", "rings")
    early = small.x < 0.9
    np.testing.assert_allclose(small.y[early], np.interp(small.x[early], closed.x, closed.y), rtol=0.03, atol=0.01)
    assert np.isfinite(small.y).all()


def test_kolter() -> None:
    """w_TD at p = .5 and ε = .01 errs by .013780 where .004852 is possible; p* from the rational function."""
    drawing = figure_kolter(num_steps=60, num_seeds=5)
    left, right = drawing.panels
    e = 0.01
    p_star = (2961 + 45240 * e + 40400 * e**2) / (4141 + 84840 * e + 40400 * e**2)
    assert drawing.known["p* at ε = 0.01"] == pytest.approx(p_star, rel=1e-12)
    below, beyond = (left.curve("fixed point, ε = 0.01" + part, "dashed") for part in ("", ", beyond"))
    assert np.interp(0.5, below.x, below.y) == pytest.approx(0.013780, rel=0.02)
    assert left.curve("best weight, ε = 0.01", "dotted").y[0] == pytest.approx(0.004852, abs=5e-7)
    # p = .9 by the definition: both states lead evenly to features (1, 1.06) and values (1, 1.05)
    d, x, v = np.array([0.9, 0.1]), np.array([1.0, 1.06]), np.array([1.0, 1.05])
    w = d @ (x * (v - 0.99 * v.mean())) / (d @ (x * (x - 0.99 * x.mean())))
    assert np.interp(0.9, beyond.x, beyond.y) == pytest.approx(np.sqrt(np.mean((w * x - v) ** 2)), rel=1e-3)
    assert below.x[-1] < p_star < beyond.x[0] and min(below.y[-1], beyond.y[0]) > 50
    measured = right.curve("measured", "points")
    assert ((measured.y > 1) == (measured.x > p_star)).all()
    exact = right.curve("exact", "dashed")
    np.testing.assert_allclose(measured.y, np.interp(measured.x, exact.x, exact.y), atol=1e-9)


def test_chattering() -> None:
    """The share of a is 1.85/2.70, the two pulls .739130 and −.480519: by hand, in the problem's own words."""
    weight, share = figure_chattering(num_steps=4000, num_seeds=20).panels
    assert weight.curve("limit if a stays greedy", "dashed").y[0] == pytest.approx(0.739130, abs=5e-7)
    assert weight.curve("limit if b stays greedy", "dashed").y[0] == pytest.approx(-0.480519, abs=5e-7)
    assert share.curve("exact", "dashed").y[0] == pytest.approx(1.85 / 2.70, rel=1e-12)
    sampled = share.curve("sampled")
    assert sampled.y[-1] == pytest.approx(1.85 / 2.70, abs=0.02)
    late = weight.curve("sampled").y[100:]
    assert np.abs(late).max() < 0.1 and late.min() < 0 < late.max()


def test_fitted() -> None:
    """Max |V| of the quadratic fit by an independent iteration of the normal equations; its growth at the end."""
    drawing = figure_fitted()
    (panel,) = drawing.panels
    for sweeps, largest in {12: 6.0722, 25: 10.5909, 40: 12.5578, 400: 5.4285e4, 500: 1.9097e8}.items():
        assert at(panel, "quadratic, γ = 1", sweeps) == pytest.approx(largest, rel=5e-5)
    assert drawing.known["growth"] == pytest.approx(1.0850436, abs=1e-6)
    assert drawing.known["exact"] == 19.0  # 19 steps east and 19 north, half each
    discounted = panel.curve("quadratic, γ = 0.99")
    assert discounted.y.max() == pytest.approx(16.236299, rel=1e-6)  # six hand-written monomials, normal equations
    assert discounted.y[-1] == pytest.approx(15.7334, rel=1e-4)
    for label, style in (("nearest neighbour, γ = 1", "rings"), ("local lines (LWR), γ = 1", "line")):
        curve = panel.curve(label, style)
        assert curve.x[-1] >= 480 and curve.y.max() < 20


def test_closed_forms_of_lambda_and_phi() -> None:
    """61/66 by hand at γ = .99; for other n and γ the sign of the spectrum on both sides, from the definition."""
    assert star_critical_lambda(0.99) == pytest.approx(61 / 66, rel=1e-12)
    for n, gamma in ((6, 0.99), (6, 0.9), (5, 0.97), (8, 0.9), (9, 0.99)):
        X, P = np.asarray(star(n).features), np.tile(np.eye(n + 1)[n], (n + 1, 1))
        unit, basis = np.eye(n + 1), np.linalg.svd(X)[2][: n + 1].T

        def least(lambda_: float, phi: float, X=X, P=P, unit=unit, basis=basis, gamma=gamma) -> float:
            left = np.linalg.inv(unit - gamma * lambda_ * P)
            G = ((unit - phi * gamma * P) @ X).T @ left @ (X - gamma * P @ X)
            return float(np.linalg.eigvals(basis.T @ G @ basis).real.min())

        lambda_, phi = star_critical_lambda(gamma, n), star_critical_phi(gamma, n)
        assert least(lambda_ - 1e-5, 0) < 0 < least(lambda_ + 1e-5, 0)
        assert least(0, phi - 1e-5) < 0 < least(0, phi + 1e-5)
    assert star_critical_lambda(0.88) == star_critical_phi(0.88) == 0.0  # below 15/17
    assert star_critical_phi(0.99, num_upper=4) == 0.0  # never diverges


def test_critical_curves() -> None:
    drawing = figure_critical_curves(num_gammas=3)
    for panel, exact in zip(drawing.panels, (star_critical_lambda, star_critical_phi), strict=True):
        found = panel.curve("scan", "points")
        np.testing.assert_allclose(found.y, [exact(float(g)) for g in found.x], atol=1e-9)
        for label, style, side in (("run converges", "rings", 1), ("run diverges", "points", -1)):
            ran = panel.curve(label, style)
            assert len(ran.x) and (side * (ran.y - [exact(float(g)) for g in ran.x]) > 0).all()


def test_representations() -> None:
    """The linear features' errors by an independent float64 iteration; the growth predicted for them is 1.0023925."""
    errors, values = figure_representations(num_steps=89, after=60).panels  # 90 points: every sweep is drawn
    linear = errors.curve("linear")
    assert linear.y[[0, 10]] == pytest.approx([5.318432, 6.469824], rel=1e-6)
    predicted = errors.curve("linear, predicted", "dashed")
    assert (predicted.y[-1] / predicted.y[0]) ** (1 / predicted.x[-1]) == pytest.approx(1.0023925, abs=1e-7)
    assert values.curve("exact", "dashed").y.tolist() == [0.0] * 7
    assert [curve.label for curve in values.curves[:5]] == [
        "table", "linear", "action-input", "separate", "action-output"
    ]  # fmt: skip
    assert values.curve("linear", "points").y[6] > values.curve("linear", "points").y[0] > 3


# --- drawing ----------------------------------------------------------------------------------------------------------


def small_drawing() -> Drawing:
    x = np.arange(4.0)
    curves = (
        Series("ours", x, x * 1e3 + 0.123456789, low=x, high=x * 2e3),
        Series("exact", x, x, "dashed", 6),
        Series("points", x, np.array([1, np.nan, np.inf, 2]), "rings", 1),
        Series("unlisted", x, x, "dotted", listed=False),
    )
    panels = (Panel("p", "x", "y", curves), Panel("q", "x", "y", curves[:1], "log", "symlog", verticals=((2.0, "v"),)))
    return Drawing("small-one", "A title", "Nobody 1900", "What is exact & what is not.", panels)


def test_an_svg_is_well_formed_titled_and_says_what_is_exact() -> None:
    pytest.importorskip("matplotlib", reason="the plot extra is not installed")
    drawing = small_drawing()
    text = svg_of(drawing)
    root = ElementTree.fromstring(text)
    assert root.attrib["role"] == "img"
    assert [child.text for child in root[:2]] == ["A title", "What is exact & what is not. Source: Nobody 1900."]
    ids = set(re.findall(r'\bid="([^"]+)"', text))
    assert all(name.startswith("small-one") for name in ids)
    referred = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text))
    assert {a or b for a, b in referred} <= ids
    assert 'transform="scale(0.015625)"' in text  # a factor is no place, and is not rounded
    assert svg_of(drawing) == text  # the same bytes for the same numbers
    plain = svg_of(drawing, with_caption=False)
    assert len(plain) < len(text) and "Source: Nobody 1900" in plain  # still there for who cannot see it


def test_compact_svg_paints_what_matplotlib_does() -> None:
    """Every path of a line ends where the curve does, to a hundredth of a point."""
    pytest.importorskip("matplotlib", reason="the plot extra is not installed")
    drawing = small_drawing()
    line = Series("one", np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0]))
    panel = replace(drawing.panels[0], curves=(line,), x_limits=(0, 2), y_limits=(0, 1))
    text = svg_of(replace(drawing, panels=(panel,)), with_caption=False)
    paths = [re.findall(r"-?[\d.]+", d) for d in re.findall(r' d="(M[^"]*)"[^>]*stroke:#0072b2', text)]
    (x0, y0, x1, y1, x2, y2), *_ = ([float(number) for number in path] for path in paths if len(path) == 6)
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.02) and x1 > x0
    assert y0 == pytest.approx(y2, abs=0.01) and y1 < y0  # down is up in an SVG


def test_a_png_is_one() -> None:
    pytest.importorskip("matplotlib", reason="the plot extra is not installed")
    picture = png_of(small_drawing())
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")
    assert int.from_bytes(picture[16:20], "big") == 1380  # two panels of 4.6 inches at 150 dots


def test_a_curve_that_is_not_there() -> None:
    with pytest.raises(ValueError, match=r"'p' has no curve 'theirs' \(line\); it has 'ours' \(line\)"):
        small_drawing().panels[0].curve("theirs")


def run_script(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> list[str]:
    monkeypatch.setattr(sys, "argv", [SCRIPT, *arguments])
    runpy.run_path(SCRIPT, run_name="__main__")
    return capsys.readouterr().out.splitlines()


@pytest.mark.slow
def test_script_lists_and_draws(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="the plot extra is not installed")
    assert [line.split()[0] for line in run_script(monkeypatch, capsys, "--list")] == list(FIGURES)
    lines = run_script(monkeypatch, capsys, "spiral", "--out", str(tmp_path / "new"))
    assert [line.split()[0] for line in lines] == ["spiral"]
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"spiral.svg", "spiral.png"}
    run_script(monkeypatch, capsys, "sb-11-6", "--out", str(tmp_path / "svg"), "--format", "svg", "--no-caption")
    assert [path.name for path in (tmp_path / "svg").iterdir()] == ["sb-11-6.svg"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["baird"], "no figure is called 'baird'; there are sb-11-2"), (["--format", "pdf"], "formats are svg and png")],
)
def test_script_refuses(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run_script(monkeypatch, capsys, *arguments)
    assert ended.value.code == 2 and message in capsys.readouterr().err


def test_script_says_how_to_get_matplotlib(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # importing it now raises ImportError
    with pytest.raises(SystemExit, match=re.escape('pip install "neuralq[plot]"')):
        run_script(monkeypatch, capsys, "spiral", "--out", str(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(FIGURES))
def test_every_figure_is_drawn(name: str) -> None:
    pytest.importorskip("matplotlib", reason="the plot extra is not installed")
    drawing = FIGURES[name]()
    assert drawing.name == name and drawing.caption.endswith(".")
    assert re.search(r"exact|Exact", drawing.caption) and re.search(r"seeds|sampled", drawing.caption)
    for panel in drawing.panels:
        for curve in panel.curves:
            assert len(curve.x) == len(curve.y), curve.label
            if curve.low is not None and curve.high is not None:
                assert len(curve.low) == len(curve.high) == len(curve.x)
    ElementTree.fromstring(svg_of(drawing))
    assert len(png_of(drawing)) > 20_000
