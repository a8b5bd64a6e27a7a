"""Singh 1992 and Lin 1993: tasks made of tasks, learned from modules with a gate, or from skills with a coordinator."""

from neuralq.systems.hierarchies.system import HIERARCHIES

__all__ = ["HIERARCHIES"]
