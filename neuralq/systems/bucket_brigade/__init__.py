"""Holland 1986: rules that pay each other; and Wilson 1994, whose ZCS learns by it to find food in Woods1."""

from neuralq.systems.bucket_brigade.system import BUCKET_BRIGADE

__all__ = ["BUCKET_BRIGADE"]
