"""Mitchell & Thrun 1993: a theory that explains what was seen tells a network the slopes of its targets."""

from neuralq.systems.ebnn.system import EBNN

__all__ = ["EBNN"]
