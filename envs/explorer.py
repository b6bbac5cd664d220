"""A behaviour for grid worlds whose transitions are known: a walk from cell to cell."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.tables import Table
from popl_rl.keys import INFO

__all__ = ["Explorer"]


class Explorer:
    """Walks to one random cell after the other by a shortest path.

    What it shows links everything that raters may care about: without it no segment of
    `popl_rl.envs.two_doors.TwoDoors` shows both doors, and then nothing that is said about
    one door has to do with what is said about the other, so that without rater ids the groups could
    not be told apart.

    Args:
        table: The world's transitions.
        cells: What tells apart the places to go to, in every state, ``[S, K]`` int64: column and
            row, perhaps with what else can be changed. Where no way leads there, somebody acts at
            random and then goes elsewhere.
        slip: Chance of a uniformly random action.
    """

    def __init__(self, table: Table, cells: Tensor, *, slip: float = 0.1) -> None:
        self.slip = slip
        distinct, self._cell = cells.unique(dim=0, return_inverse=True)
        # Fewest steps from each state to each cell, [cell, state]; never over the goal, where an
        # episode would end.
        self._far = far = torch.tensor(1e6)
        distance = torch.where(self._cell == torch.arange(len(distinct)).unsqueeze(1), 0.0, far)
        while True:
            ahead = torch.where(table.terminal, far, 1 + distance[:, table.next_state])
            shorter = torch.minimum(distance, ahead.amin(-1))
            if torch.equal(shorter, distance):
                break
            distance = shorter
        self._ahead = ahead
        self._targets = (distance < far).any(1).nonzero().squeeze(-1)
        ends = table.next_state[table.terminal]
        self._targets = self._targets[~torch.isin(self._targets, self._cell[ends])]
        self._target = torch.empty(0, dtype=torch.long)

    def reset(self) -> None:
        """Forget where everybody was going: a batch of new episodes begins."""
        self._target = torch.empty(0, dtype=torch.long)

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        """Return the actions ``[B]`` of a batch of walkers."""
        state = step[INFO, "next_state"].long()
        drawn = torch.randint(len(self._targets), state.shape, generator=generator)
        fresh = self._targets[drawn]
        if len(self._target):
            arrived = self._cell[state] == self._target
            astray = self._ahead[self._target, state].amin(-1) >= self._far
            self._target = torch.where(arrived | astray, fresh, self._target)
        else:
            self._target = fresh
        ahead = self._ahead[self._target, state]
        tie_break = torch.rand(ahead.shape, generator=generator) * 0.5
        action = (ahead + tie_break).argmin(-1)
        random = torch.randint(ahead.shape[-1], state.shape, generator=generator)
        slips = torch.rand(state.shape, generator=generator) < self.slip
        return torch.where(slips, random, action)
