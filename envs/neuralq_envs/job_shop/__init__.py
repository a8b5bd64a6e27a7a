"""Job-shop scheduling by repair: problems, what repairs make of their schedules, and the Gymnasium environment."""

from neuralq_envs.job_shop.env import JobShopEnv, Repair, make
from neuralq_envs.job_shop.problem import JobShop, random_job_shop

__all__ = ["JobShop", "JobShopEnv", "Repair", "make", "random_job_shop"]
