"""The same self-play once more, as plain PyTorch and the project's own rules: slower on a CPU, at home on a GPU.

It shares the game with `neuralq.systems.backgammon.kernels` and none of its arithmetic: all 198 inputs, gradients by
autograd, traces by `neuralq.rules.accumulate`, returns by `neuralq.rules.lambda_returns`. What equals what, in float64:

* `play_online` draws the same dice in the same order as the kernel of that name: from one generator both play the same
  games, and the weights agree within 1e-10 after 200 games.
* games played one after another from one generator are those of the kernel `play_batch`, and the gradient is the same
  within 1e-10.
* `play_in_lockstep` plays many games at once, the afterstates of all of them being judged in one forward pass, and
  this is what batched learning with this engine does. Here every game has a generator of its own, for otherwise the
  dice would depend on which games are played beside it. A game is then the one that the kernel plays from that
  generator; but the batch that a seed stands for is another than the compiled engine's, where one generator serves all
  games of a thread.

Tesauro's inputs are made on the device, so that a board travels as 50 bytes; legal turns are found, and expert inputs
made, by the compiled rules on the CPU.

Sources: Tesauro (1992), "Practical issues in temporal difference learning"; Sutton & Barto (2018), section 16.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuralq.learners.optim import FlatOptimiser, Optimiser
from neuralq.rules import accumulate, lambda_returns
from neuralq.systems.backgammon.network import ValueNetwork, equities
from neuralq_envs.backgammon.expert import NUM_EXPERT, expert_inputs
from neuralq_envs.backgammon.inputs import NUM_INPUTS
from neuralq_envs.backgammon.rules import BAR, MAX_AFTERSTATES, NUM_CHECKERS, START, Board, afterstates, result

__all__ = [
    "Games",
    "TorchBatch",
    "TorchValues",
    "batch_gradient",
    "dense_inputs",
    "outcome",
    "play_in_lockstep",
    "play_online",
    "seen_by_first",
]

_FIRST_ROOM = 64  # afterstates for which a game gets room; a turn has about 20


class Games(NamedTuple):
    """Games that began together, one per column; row t is what the side to move saw before turn t."""

    boards: Board  # [T, B, 2, 25]; rows after a game's end mean nothing
    num_turns: NDArray[np.int64]  # [B]
    points: NDArray[np.int64]  # [B] what the player who moved first has won


class TorchValues(torch.nn.Module):
    """The network of `ValueNetwork` as a module: ``y = σ(V σ(Wᵀx) + c)``.

    All weights are one parameter, ``flat``, laid out as `ValueNetwork.flat`; on a CPU it is the same memory.

    Args:
        network: where the weights come from.
        device: "cpu", "cuda" or "cuda:1" and so on.

    Raises:
        ValueError: a device that this computer has not.

    Example:
        >>> network = ValueNetwork.drawn(40, 4, np.random.default_rng(0), dtype=np.float64)
        >>> y = TorchValues(network)(torch.from_numpy(START[None].copy()))
        >>> y.shape, bool(np.allclose(y.detach().numpy(), network.outputs(START[None]), rtol=1e-14))
        (torch.Size([1, 4]), True)
    """

    def __init__(self, network: ValueNetwork, device: str = "cpu") -> None:
        super().__init__()
        self.device = torch.device(device)
        if self.device.type == "cuda" and (self.device.index or 0) >= torch.cuda.device_count():
            raise ValueError(f"device={device!r} asks for a GPU that is not there; use device='cpu'")
        self.num_hidden, self.num_outputs = network.num_hidden, network.num_outputs
        self._num_rows = len(network.w)
        self.flat = torch.nn.Parameter(torch.from_numpy(network.flat).to(self.device))

    def forward(self, boards: Tensor) -> Tensor:
        """Outputs ``[n, K]`` of boards ``[n, 2, 25]``, int8; not of games that are over."""
        hidden, outputs = self.num_hidden, self.num_outputs
        end = self._num_rows * hidden
        w, v, c = self.flat[:end].view(-1, hidden), self.flat[end:-outputs].view(outputs, hidden), self.flat[-outputs:]
        z = torch.addmm(w[NUM_INPUTS], dense_inputs(boards.to(self.device), w.dtype), w[:NUM_INPUTS])
        if self._num_rows > NUM_INPUTS + 1:
            z = torch.addmm(z, _expert_inputs(boards, w.dtype).to(self.device), w[NUM_INPUTS + 1 :])
        return torch.sigmoid(torch.addmm(c, torch.sigmoid(z), v.T))

    @torch.no_grad()
    def read(self, network: ValueNetwork) -> None:
        """Takes the weights of ``network``."""
        self.flat.copy_(torch.from_numpy(network.flat))

    @torch.no_grad()
    def write(self, network: ValueNetwork) -> None:
        """Gives ``network`` these weights."""
        network.flat[:] = self.flat.cpu().numpy()


def dense_inputs(boards: Tensor, dtype: torch.dtype) -> Tensor:
    """Tesauro's 198 inputs of many boards at once, the side to move being player 0.

    Args:
        boards: int8 ``[n, 2, 25]``, on any device.
        dtype: of the inputs.

    Returns:
        ``[n, 198]``, equal to those of `neuralq_envs.backgammon.inputs.tesauro_dense` to the bit.

    Source: Tesauro 1992; Sutton & Barto 2018, section 16.1.

    Example:
        >>> dense_inputs(torch.from_numpy(START[None].copy()), torch.float32)[0, 20:24]
        tensor([1., 1., 1., 1.])
    """
    n = boards.to(dtype)
    on_points = n[:, :, :BAR, None]
    least = torch.arange(1, 4, dtype=dtype, device=n.device)
    units = torch.cat([(on_points >= least).to(dtype), (on_points - 3).clamp(min=0) / 2], -1)
    bar, off = n[:, :, BAR:] / 2, (NUM_CHECKERS - n.sum(-1, keepdim=True)) / NUM_CHECKERS
    sides = torch.cat([units.flatten(2), bar, off], -1)
    to_move = torch.tensor([1.0, 0.0], dtype=dtype, device=n.device).expand(len(n), 2)
    return torch.cat([sides.flatten(1), to_move], 1)


def seen_by_first(y: Tensor, first_moves: Tensor) -> Tensor:
    """Outputs of the side to move as the player who moved first sees them: ``V[k] = y[(k + K/2) mod K]``, or ``1 − y``.

    Args:
        y: ``[*n, K]``.
        first_moves: whether it is that player who is to move, bool ``[*n]`` or what broadcasts to it.

    Returns:
        ``[*n, K]``.

    Example:
        >>> seen_by_first(torch.tensor([[0.5, 0.25, 0.125, 0.0]]), torch.tensor([False]))
        tensor([[0.1250, 0.0000, 0.5000, 0.2500]])
    """
    turned_around = 1 - y if y.shape[-1] == 1 else y.roll(y.shape[-1] // 2, -1)
    return torch.where(first_moves[..., None], y, turned_around)


def outcome(points: Tensor, num_outputs: int, dtype: torch.dtype) -> Tensor:
    """What the outputs should have been: 1 for what has happened, ``[n, K]``. With four a backgammon is a gammon.

    Args:
        points: won by whoever looks, ±1 to ±3, ``[n]``.
        num_outputs: K: 6, 4 or 1.
        dtype: of the answer.

    Example:
        >>> outcome(torch.tensor([1, -3]), 4, torch.float32)
        tensor([[1., 0., 0., 0.],
                [0., 0., 0., 1.]])
    """
    if num_outputs == 1:
        return (points > 0).to(dtype)[:, None]
    kinds = num_outputs // 2
    kind = kinds * (points < 0).long() + points.abs().clamp(max=kinds).long() - 1
    return torch.nn.functional.one_hot(kind, num_outputs).to(dtype)


def play_online(
    values: TorchValues,
    rates: Iterable[float],
    lambdas: Iterable[float],
    rng: np.random.Generator,
    tally: NDArray[np.int64],
) -> None:
    """Plays a game for each of ``rates``, learning after every turn: ``θ ← θ + α Σₖ δₖ zₖ``.

    Args:
        values: learns.
        rates: the step size α of each game.
        lambdas: λ in [0, 1] of each game.
        rng: draws the dice.
        tally: plain games, gammons, backgammons and turns, ``[4]``; added to.

    Source: Tesauro 1992; Sutton 1988, eq. 4.

    Example:
        >>> tally = np.zeros(4, np.int64)
        >>> network = ValueNetwork.drawn(4, 1, np.random.default_rng(0), dtype=np.float64)
        >>> play_online(TorchValues(network), [0.1], [0.7], np.random.default_rng(0), tally)
        >>> int(tally[:3].sum())
        1
    """
    for rate, lambda_ in zip(rates, lambdas, strict=True):
        _play_one_online(values, float(rate), float(lambda_), rng, tally)


def _play_one_online(
    values: TorchValues, rate: float, lambda_: float, rng: np.random.Generator, tally: NDArray[np.int64]
) -> None:
    board, room = START.copy(), np.empty((MAX_AFTERSTATES, 2, 25), np.int8)
    z = torch.zeros(values.num_outputs, values.flat.numel(), dtype=values.flat.dtype, device=values.device)
    turns, points = 0, 0
    while points == 0:
        first_moves = torch.tensor([turns % 2 == 0], device=values.device)
        v_tm1 = seen_by_first(values(torch.from_numpy(board[None])), first_moves)[0]
        grads = [torch.autograd.grad(v, values.flat, retain_graph=True)[0] for v in v_tm1.unbind()]
        z = accumulate(z, torch.stack(grads), lambda_)
        count = afterstates(board, *_roll(rng, turns == 0), room)
        board = room[_worst_for_other(values, room[:count], np.zeros(1, np.int64))[0]].copy()
        turns += 1
        points = int(result(board))
        with torch.no_grad():
            if points != 0:
                y = outcome(torch.tensor([points]), values.num_outputs, z.dtype).to(values.device)
            else:
                y = values(torch.from_numpy(board[None]))
            delta = seen_by_first(y, ~first_moves)[0] - v_tm1
            values.flat.add_(delta @ z, alpha=rate)
    tally[abs(points) - 1] += 1
    tally[3] += turns


def play_in_lockstep(values: TorchValues, dice: Sequence[np.random.Generator]) -> Games:
    """Plays as many games as there are generators, all at once; the weights stay as they are.

    Args:
        values: play both sides.
        dice: one generator for each game, none twice.

    Raises:
        ValueError: no generator, or one that is to serve two games.

    Example:
        >>> values = TorchValues(ValueNetwork.drawn(4, 1, np.random.default_rng(0)))
        >>> games = play_in_lockstep(values, np.random.default_rng(0).spawn(2))
        >>> games.boards.shape[:2] == (games.num_turns.max(), 2)
        True
    """
    if not dice or len({id(rng) for rng in dice}) < len(dice):
        raise ValueError("every game needs a generator of its own, or the dice would depend on the other games")
    boards = np.repeat(START[None], len(dice), 0)
    room = np.empty((_FIRST_ROOM * len(dice) + MAX_AFTERSTATES, 2, 25), np.int8)
    history: list[Board] = []
    alive = list(range(len(dice)))
    num_turns, points = np.zeros(len(dice), np.int64), np.zeros(len(dice), np.int64)
    while alive:
        history.append(boards.copy())
        starts, total = np.empty(len(alive), np.int64), 0
        for i, game in enumerate(alive):
            if len(room) - total < MAX_AFTERSTATES:
                room = np.concatenate([room, np.empty_like(room)])
            starts[i] = total
            total += afterstates(boards[game], *_roll(dice[game], len(history) == 1), room[total:])
        boards[alive] = room[_worst_for_other(values, room[:total], starts)]
        for ended in np.flatnonzero(~boards[:, 1].any(1) & (points == 0)):
            num_turns[ended], won = len(history), -int(result(boards[ended]))  # by the side that has just moved
            points[ended] = won if len(history) % 2 == 1 else -won
        alive = [game for game in alive if points[game] == 0]
    return Games(np.stack(history), num_turns, points)


def batch_gradient(values: TorchValues, games: Games, lambda_: float) -> Tensor:
    """Along which the λ-returns of all turns are missed by more: the mean over turns of ``−Σₖ (Gₜ − Vₜ)ₖ ∇Vₜₖ``.

    Values and returns are those of the player who moved first, for a return that carries on must not change sides.

    Args:
        values: of which the gradient is taken; the same that played.
        games: to learn from.
        lambda_: λ in [0, 1].

    Returns:
        ``[d]``, d being the number of weights.

    Raises:
        ValueError: if ``lambda_`` is outside [0, 1].

    Source: Watkins 1989; Sutton & Barto 2018, section 12.1.

    Example:
        With weights of 0 all values are ½, and with λ = 0 only each game's last turn teaches: its mover has won.

        >>> values = TorchValues(ValueNetwork(1, 1, np.float64))
        >>> games = play_in_lockstep(values, np.random.default_rng(0).spawn(3))
        >>> (batch_gradient(values, games, 0.0)[-1] * games.num_turns.sum()).item()  # −(1 − ½) · ½ · ½ in each
        -0.375
    """
    device, dtype = values.device, values.flat.dtype
    rows = torch.arange(len(games.boards), device=device)
    num_turns = torch.from_numpy(games.num_turns).to(device)
    live = rows[:, None] < num_turns
    y_live = values(torch.from_numpy(games.boards).to(device)[live])
    y = torch.zeros(*live.shape, values.num_outputs, dtype=dtype, device=device).index_put((live,), y_live)
    v = seen_by_first(y, (rows % 2 == 0)[:, None])
    with torch.no_grad():
        ends = (rows[:, None] == num_turns - 1)[..., None].expand_as(v)
        won = outcome(torch.from_numpy(games.points).to(device), values.num_outputs, dtype)
        v_t = torch.cat([v[1:], v[-1:]])
        returns = lambda_returns(ends * won, (~ends).to(dtype), v_t, lambda_, ends)
    loss = 0.5 * ((returns - v) ** 2)[live].sum() / num_turns.sum()
    return torch.autograd.grad(loss, values.flat)[0]


class TorchBatch:
    """Plays a batch of games in lockstep on one device, and takes one step of Adam on the λ-returns of all turns.

    Args:
        network: learns; its weights are up to date after every step.
        batch_games: games between two steps.
        device: "cpu", "cuda" and so on.

    Example:
        >>> network = ValueNetwork.drawn(4, 4, np.random.default_rng(0))
        >>> before, tally = network.sha256(), np.zeros(4, np.int64)
        >>> TorchBatch(network, 2).step(0.001, 0.7, [np.random.default_rng(0)], tally)
        >>> network.sha256() != before, int(tally[:3].sum())
        (True, 2)
    """

    def __init__(self, network: ValueNetwork, batch_games: int, device: str = "cpu") -> None:
        self.values = TorchValues(network, device)
        self.optimiser = FlatOptimiser(Optimiser("adam"), self.values.flat.detach())
        self._network = network
        self._batch_games = batch_games

    def step(self, rate: float, lambda_: float, dice: Sequence[np.random.Generator], tally: NDArray[np.int64]) -> None:
        """Adds to ``tally``; the first generator of ``dice`` says where each game's own begins."""
        self.values.read(self._network)
        seeds = dice[0].integers(2**63, size=self._batch_games)
        games = play_in_lockstep(self.values, [np.random.default_rng(seed) for seed in seeds])
        self.learn(games, rate, lambda_)
        self.values.write(self._network)
        tally[:3] += np.bincount(np.abs(games.points) - 1, minlength=3)
        tally[3] += games.num_turns.sum()

    def learn(self, games: Games, rate: float, lambda_: float) -> None:
        """One step on games played with the present weights."""
        self.optimiser.step(batch_gradient(self.values, games, lambda_), rate)


def _expert_inputs(boards: Tensor, dtype: torch.dtype) -> Tensor:
    x = torch.empty(len(boards), NUM_EXPERT, dtype=dtype)
    for board, row in zip(boards.cpu().numpy(), x.numpy(), strict=True):
        expert_inputs(board, row)
    return x


def _roll(rng: np.random.Generator, opening: bool) -> tuple[int, int]:
    while True:
        die_1, die_2 = 1 + int(6 * rng.random()), 1 + int(6 * rng.random())
        if die_1 != die_2 or not opening:
            return die_1, die_2


@torch.no_grad()
def _worst_for_other(values: TorchValues, boards: Board, starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where in ``boards`` the worst for the side then to move is, for each of the groups that begin at ``starts``."""
    y: NDArray[Any] = values(torch.from_numpy(boards)).cpu().numpy()
    equity = equities(y)
    for i in np.flatnonzero(~boards[:, 1].any(1)):
        equity[i] = result(boards[i])
    lowest = np.repeat(np.minimum.reduceat(equity, starts), np.diff(starts, append=len(boards)))
    hits = np.flatnonzero(equity == lowest)
    found: NDArray[np.int64] = hits[np.searchsorted(hits, starts)]  # the first of equals
    return found
