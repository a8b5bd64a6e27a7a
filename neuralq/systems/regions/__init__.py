"""Dietterich & Flann 1997: dynamic programming on regions, regressed through operators, beside that on states."""

from neuralq.systems.regions.system import REGIONS

__all__ = ["REGIONS"]
