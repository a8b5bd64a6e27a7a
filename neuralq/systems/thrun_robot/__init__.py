"""After Thrun 1996: a robot that learns to find its target, with a theory that explains its episodes or without."""

from neuralq.systems.thrun_robot.system import THRUN_ROBOT

__all__ = ["THRUN_ROBOT"]
