"""Ring 1994: nine mazes one after the other, learned by units that grow where the present is not enough."""

from neuralq.systems.child.system import CHILD

__all__ = ["CHILD"]
