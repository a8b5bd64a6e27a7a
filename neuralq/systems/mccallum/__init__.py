"""McCallum 1995: in a maze where cells look alike, memory tells them apart, and only where it is of use."""

from neuralq.systems.mccallum.system import MCCALLUM

__all__ = ["MCCALLUM"]
