"""Representations of action values: a table, linear features and the three network layouts of Mitchell (1997), §13.6.

Every class here is a `neuralq.types.QFunction`: ``all(s)`` gives the values of every action, ``at(s, a)`` those of the
actions named, and the second always equals the first gathered at ``a``. What differs is which estimates one update
moves along with the one it was meant for, and that is what decides whether training converges.
"""

from neuralq.q.advice import Rule, insert_rules
from neuralq.q.bodies import MLP, Conv
from neuralq.q.custom import BODIES, Body, Custom
from neuralq.q.distributional import CategoricalQ, QuantileQ
from neuralq.q.dueling import DuelingQ
from neuralq.q.flat import FlatParameters
from neuralq.q.implicit import ImplicitQuantileQ
from neuralq.q.layouts import ActionInputQ, ActionOutputQ, SeparateQ
from neuralq.q.masked import MaskedQ
from neuralq.q.named_bodies import NAMED_BODIES, body_for
from neuralq.q.recurrent import GRU, RecurrentQ
from neuralq.q.table_and_linear import LinearQ, TableQ

__all__ = [
    "BODIES",
    "GRU",
    "MLP",
    "NAMED_BODIES",
    "ActionInputQ",
    "ActionOutputQ",
    "Body",
    "CategoricalQ",
    "Conv",
    "Custom",
    "DuelingQ",
    "FlatParameters",
    "ImplicitQuantileQ",
    "LinearQ",
    "MaskedQ",
    "QuantileQ",
    "RecurrentQ",
    "Rule",
    "SeparateQ",
    "TableQ",
    "body_for",
    "insert_rules",
]
