"""Not a module to import: ``python -m neuralq.dqn`` is what people type first, and is told what there is instead."""

import sys

__all__: list[str] = []

if __name__ == "__main__":
    sys.exit("neuralq: algorithms are options: python -m neuralq train CartPole-v1 --learner replay")
