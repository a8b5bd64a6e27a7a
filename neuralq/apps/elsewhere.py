"""Names that people bring along from other libraries, and what there is in their place."""

from __future__ import annotations

__all__ = ["instead_of"]

_TRAIN = 'neuralq.train("CartPole-v1", learner="replay")'
_NO_POLICY_GRADIENT = f"{_TRAIN}, which trains a value function: there are no policy gradients here"
_MAKE = 'gymnasium.make("CartPole-v1"), which neuralq.train and neuralq.solve take'
_INSTEAD = {
    **dict.fromkeys(("DQN", "DQNPolicy", "DQNAgent", "DoubleDQN", "Rainbow", "RainbowPolicy"), _TRAIN),
    **dict.fromkeys(("PQN", "QLearning", "Sarsa", "Trainer", "OffpolicyTrainer", "Experiment"), _TRAIN),
    **dict.fromkeys(("PPO", "A2C", "SAC", "TD3", "DDPG", "TRPO"), _NO_POLICY_GRADIENT),
    **dict.fromkeys(("make", "make_env", "Env", "register", "spaces"), _MAKE),
    **dict.fromkeys(
        ("make_vec", "make_vec_env", "DummyVecEnv", "SubprocVecEnv", "SyncVectorEnv", "AsyncVectorEnv"),
        'neuralq.train("CartPole-v1", num_envs=8), which makes them',
    ),
    **dict.fromkeys(("evaluate_policy", "test", "enjoy"), "neuralq.evaluate(agent)"),
    **dict.fromkeys(("QNetwork", "MlpPolicy", "Net", "MLP"), "neuralq.ActionOutputQ(4, 2)"),
    **dict.fromkeys(("set_random_seed", "seed", "set_seed"), 'neuralq.train("CartPole-v1", seed=1)'),
    **dict.fromkeys(
        ("PrioritizedReplayBuffer", "VectorReplayBuffer", "Collector"), "neuralq.ReplayBuffer(1000, (4,), np.float32)"
    ),
    "learn": "neuralq.train, and neuralq.resume(run, total_steps=...) to go on",
    "save": 'the run folder, where everything is saved; neuralq.export(run, "q.safetensors") writes the network alone',
    "value_iteration": 'neuralq.solve("FrozenLake-v1", method="value-iteration")',
    "policy_iteration": 'neuralq.solve("FrozenLake-v1", method="policy-iteration")',
    "Agent": "neuralq.load(run), which makes one",
    "config": "neuralq.RunConfig()",
}


def instead_of(name: str) -> str | None:
    """What to write for a name of another library; None for those that nobody is known to bring.

    Example:
        >>> instead_of("evaluate_policy")
        'neuralq.evaluate(agent)'
    """
    return _INSTEAD.get(name)
