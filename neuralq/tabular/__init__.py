"""Every tabular learner of Mitchell's chapter 13 in compiled loops, on a model or on a Gymnasium environment.

Arguments with one meaning in all of them:

* ``source``: a `FiniteMDP`, an `AliasedMDP` (tables are then over its observations), a compiled `Model`, or a Gymnasium
  environment with finite spaces (slower);
* ``num_steps``: transitions of the source to learn from; ``gamma``: γ in [0, 1];
* ``policy``: how to act, a setting or its name; a replayed expected Sarsa takes its expectation, nothing else does;
* ``step_size``: α by the updates that a pair has had, real or imagined, counted from 0 in every call;
* ``seed``: of the random stream; ``options``: what to start from and what to record.

What learns from recorded transitions (`apply`, …) takes ``q``, the values to start from, which it does not change,
``[S, A]`` with NaN (or −∞) where an action is illegal; and ``experience``, whose rows carry their own discounts.
"""

from neuralq.tabular.average import r_learning
from neuralq.tabular.control import apply, double_q, expected_sarsa, q_learning, sarsa
from neuralq.tabular.engine import RunOptions
from neuralq.tabular.episodes import apply_episodes, episodic_q_learning
from neuralq.tabular.kernels.ase_ace import AseAce, AseAceRates, ase_ace_action, ase_ace_update, new_ase_ace
from neuralq.tabular.kernels.backups import BackupRule, backup_update
from neuralq.tabular.kernels.bits import (
    BitMemory,
    bit_clusters,
    bit_hamming,
    bit_table,
    bit_update,
    bit_values,
    bits_remembered,
)
from neuralq.tabular.kernels.compositional import (
    CompositionalQ,
    CompositionalRates,
    compositional_action,
    compositional_module,
    compositional_update,
    compositional_value,
    new_compositional_q,
)
from neuralq.tabular.kernels.random_numbers import new_stream
from neuralq.tabular.kernels.semi_markov import smdp_q_update
from neuralq.tabular.kernels.transition_hierarchy import (
    HierarchyRates,
    TransitionHierarchy,
    hierarchy_begin,
    hierarchy_learn,
    hierarchy_observe,
    new_transition_hierarchy,
)
from neuralq.tabular.kernels.zcs import Zcs, ZcsRates, new_zcs, zcs_action, zcs_strengths, zcs_update
from neuralq.tabular.look_ahead import Backup, alpha_beta
from neuralq.tabular.model import Model, compile_model
from neuralq.tabular.n_step import apply_n_step, n_step
from neuralq.tabular.nearest_sequences import NearestSequenceMemory
from neuralq.tabular.options import OptionOutcome, run_option
from neuralq.tabular.planning import dyna_q, prioritized_sweeping, queue_dyna
from neuralq.tabular.policies import (
    EpsilonGreedy,
    KToTheQ,
    Power,
    RandomPolicy,
    SearchThenConverge,
    Softmax,
    UpperConfidence,
    Visits,
)
from neuralq.tabular.prediction import batch_td, predict, td_lambda, under_policy
from neuralq.tabular.regions import Region, RegionOperator, RegionPlan, region_dp
from neuralq.tabular.results import Band, Curve, Experience, Learned, over_seeds
from neuralq.tabular.suffix_tree import SuffixNode, UtileSuffixMemory
from neuralq.tabular.theory import Sweeps, robbins_monro_sums, sweep_errors
from neuralq.tabular.traces import apply_lambda, q_lambda, sarsa_lambda

__all__ = [
    "AseAce",
    "AseAceRates",
    "Backup",
    "BackupRule",
    "Band",
    "BitMemory",
    "CompositionalQ",
    "CompositionalRates",
    "Curve",
    "EpsilonGreedy",
    "Experience",
    "HierarchyRates",
    "KToTheQ",
    "Learned",
    "Model",
    "NearestSequenceMemory",
    "OptionOutcome",
    "Power",
    "RandomPolicy",
    "Region",
    "RegionOperator",
    "RegionPlan",
    "RunOptions",
    "SearchThenConverge",
    "Softmax",
    "SuffixNode",
    "Sweeps",
    "TransitionHierarchy",
    "UpperConfidence",
    "UtileSuffixMemory",
    "Visits",
    "Zcs",
    "ZcsRates",
    "alpha_beta",
    "apply",
    "apply_episodes",
    "apply_lambda",
    "apply_n_step",
    "ase_ace_action",
    "ase_ace_update",
    "backup_update",
    "batch_td",
    "bit_clusters",
    "bit_hamming",
    "bit_table",
    "bit_update",
    "bit_values",
    "bits_remembered",
    "compile_model",
    "compositional_action",
    "compositional_module",
    "compositional_update",
    "compositional_value",
    "double_q",
    "dyna_q",
    "episodic_q_learning",
    "expected_sarsa",
    "hierarchy_begin",
    "hierarchy_learn",
    "hierarchy_observe",
    "n_step",
    "new_ase_ace",
    "new_compositional_q",
    "new_stream",
    "new_transition_hierarchy",
    "new_zcs",
    "over_seeds",
    "predict",
    "prioritized_sweeping",
    "q_lambda",
    "q_learning",
    "queue_dyna",
    "r_learning",
    "region_dp",
    "robbins_monro_sums",
    "run_option",
    "sarsa",
    "sarsa_lambda",
    "smdp_q_update",
    "sweep_errors",
    "td_lambda",
    "under_policy",
    "zcs_action",
    "zcs_strengths",
    "zcs_update",
]
