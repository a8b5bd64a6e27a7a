"""Baird's star learned by a table, by linear features and by three network layouts: predicted, then measured.

    python scripts/baird.py [--svg star.svg] [--num-steps 5000] [--gamma 0.99] [--step-size 0.01] [--num-upper 6]

It is the command ``neuralq baird``. The prediction is printed before anything is trained: the table converges, the
linear features grow by 1.0023925 per sweep, and what is said of the networks holds at their initial weights only. The
table shows what happened, beside the exact values, which are all 0. A run stops once a value passes 1e10.

    Baird's star, γ=0.99, α=0.01: the prediction, before anything is trained; expected TD diverges for γ > 0.8824
       table          ×0.9999857 per sweep: converges everywhere
       linear         ×1.0023925 per sweep: diverges everywhere
       action-input   ×1.0037821 per sweep: grows at the initial weights
       separate       ×1.0014977 per sweep: grows at the initial weights
       action-output  ×1.0031298 per sweep: grows at the initial weights

At a γ below the threshold (try --gamma 0.85) the linear features converge as well.
"""

from __future__ import annotations

import sys

from neuralq.apps.cli import main

if __name__ == "__main__" and (status := main(["baird", *sys.argv[1:]])):
    raise SystemExit(status)
