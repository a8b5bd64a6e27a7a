"""Barto, Sutton & Anderson 1983: two neuron-like elements balance a pole."""

from neuralq.systems.ase_ace.system import ASE_ACE

__all__ = ["ASE_ACE"]
