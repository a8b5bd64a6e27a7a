"""Named set-ups: configurations that say everything about a run, and the functions that carry them out."""

from neuralq.recipes.config import RunConfig
from neuralq.recipes.presets import preset_for, with_preset
from neuralq.recipes.run import Run, evaluate_run, load, resume, train

__all__ = ["Run", "RunConfig", "evaluate_run", "load", "preset_for", "resume", "train", "with_preset"]
