"""Zhang & Dietterich 1995: schedules of a job shop, repaired by what TD(λ) has learned of schedules."""

from neuralq.systems.job_shop.system import JOB_SHOP

__all__ = ["JOB_SHOP"]
