"""Baird's star learned by a table, by linear features and by three network layouts: predicted, then measured.

    python scripts/baird.py [--svg star.svg] [--num-steps 5000] [--gamma 0.99] [--step-size 0.01] [--num-upper 6]

The first table is printed before anything is trained: the table converges, the linear features grow by 1.0023925 per
sweep, and what is said of the networks holds at their initial weights only. The second shows what happened, with the
final values of an upper and of the lower state beside the exact one. A run stops once a value passes 1e10.

    Predicted: expected TD diverges for gamma > 0.8824
      table           converges   0.9999857   everywhere
      linear          diverges    1.0023925   everywhere
      action-input    grows       1.0037821   at the initial weights
      separate        grows       1.0014977   at the initial weights
      action-output   grows       1.0031298   at the initial weights
    Measured
      table           0.9999857   5000   x 1e+00       0.93       0.93   0
      linear          1.0023937   5000   x 9e+05      9e+06    1.1e+07   0
      action-input    1.0232272    400   x 8e+09    1.9e+09      2e+09   0
      separate        1.0018462   2623   x 4e+07   -1.8e+07     -2e+07   0
      action-output   1.0175804    464   x 4e+05   -1.8e+05   -1.9e+05   0

At a gamma below the threshold (try --gamma 0.85) the linear features converge as well.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from neuralq.apps.pages.star import divergence_svg
from neuralq.checks import MissingExtra
from neuralq.lab import predict_baird, run_baird
from neuralq_envs.counterexamples.baird import critical_gamma


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-steps", type=int, default=5000)
    parser.add_argument("--gamma", type=float, default=0.99)
    parser.add_argument("--step-size", type=float, default=0.01)
    parser.add_argument("--num-upper", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--svg", metavar="PATH", help="draw the errors (needs matplotlib)")
    options = parser.parse_args()
    console = Console()
    setting = (options.gamma, options.step_size, options.num_upper, options.seed)

    threshold = critical_gamma(options.num_upper)
    known = f"gamma > {threshold:.4f}" if threshold < 1 else "no gamma"
    predicted = Table(title=f"Predicted: expected TD diverges for {known}")
    for heading in ("representation", "verdict", "growth per sweep", "holds"):
        predicted.add_column(heading)
    for one in predict_baird(*setting):
        holds = "everywhere" if one.scope == "global" else "at the initial weights"
        predicted.add_row(one.representation, one.verdict, f"{one.growth:.7f}", holds)
    console.print(predicted)

    results = run_baird(options.num_steps, *setting)
    measured = Table(title="Measured")
    for heading in ("representation", "growth", "sweeps", "Q rose", "upper V", "lower V", "exact"):
        measured.add_column(heading, justify="left" if heading == "representation" else "right", no_wrap=True)
    for result in results:
        ends = (f"{value:.2g}" for value in (result.values[0], result.values[-1], result.exact_values[0]))
        rise = f"x {result.rise:.0e}"
        measured.add_row(result.representation, f"{result.measured_growth:.7f}", str(result.steps), rise, *ends)
    console.print(measured)

    if options.svg is not None:
        try:
            Path(options.svg).write_text(divergence_svg(results), encoding="utf-8")
        except MissingExtra as error:
            raise SystemExit(str(error)) from error
        console.print(f"wrote {options.svg}")


if __name__ == "__main__":
    main()
