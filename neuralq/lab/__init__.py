"""Divergence experiments: what the mathematics predicts, then what training does."""

from neuralq.lab.baird import BairdPrediction, BairdResult, predict_baird, run_baird
from neuralq.lab.expected import ExpectedBackup, expected_backup, expected_td_step, local_growth

__all__ = [
    "BairdPrediction",
    "BairdResult",
    "ExpectedBackup",
    "expected_backup",
    "expected_td_step",
    "local_growth",
    "predict_baird",
    "run_baird",
]
