"""A world of your own, complete: an environment, two groups of raters, behaviours, a table.

Somebody walks about five by five cells and leaves by the upper or by the lower exit, with lava in
between. Half of the people want the upper exit used, half the lower one; nobody says so. Change
what you like; what is called optional can go.

    python -m popl_rl.testing env my_env.py:Exits
    python -m popl_rl.testing rater my_env.py:up --env my_env.py:Exits
    popl-train --config-dir . env=my_env
"""

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from popl_rl.data.tables import Table, solve

SIZE, UPPER, LAVA, LOWER = 5, 4, 14, 24  # cells are numbered row by row
ENDS = (UPPER, LAVA, LOWER)
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # up, down, left, right


def move(cell, action):
    """What a step does: the cell after it, and the numbers that people may go by.

    Stepping and the table are both built from this function, so that they agree.
    """
    row, column = (
        min(max(place + by, 0), SIZE - 1)
        for place, by in zip(divmod(cell, SIZE), MOVES[action], strict=True)
    )
    after = SIZE * row + column
    return after, {
        "upper": float(after == UPPER),
        "lower": float(after == LOWER),
        "lava": float(after == LAVA),
    }


class Exits(gymnasium.Env):
    """Any spaces of Gymnasium will do."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (SIZE * SIZE,), np.float32)
    action_space = gymnasium.spaces.Discrete(len(MOVES))

    def reset(self, *, seed=None, options=None):
        """Begin somewhere."""
        super().reset(seed=seed)  # all randomness comes from self.np_random
        self.cell = int(self.np_random.choice(np.delete(np.arange(SIZE * SIZE), ENDS)))
        # Numbers in info become segments["info", name]. A table needs these two at reset as well.
        return self.observe(), {"state": self.cell, "next_state": self.cell}

    def step(self, action):
        """Move."""
        before = self.cell
        self.cell, numbers = move(before, int(action))
        info = {"state": before, "next_state": self.cell, **numbers}
        info["left"] = numbers["upper"] + numbers["lower"]
        # The reward is the environment's own, on which nobody is trained: rows of the results.
        return self.observe(), info["left"], self.cell in ENDS, False, info

    def observe(self):
        """Which cell it is."""
        return np.eye(SIZE * SIZE, dtype=np.float32)[self.cell]

    def transition_table(self):
        """Optional: every transition, for labels by regret and shares of the optimum."""
        told = [[move(cell, action) for action in range(4)] for cell in range(SIZE * SIZE)]
        after = torch.tensor([[cell for cell, _ in row] for row in told])
        state = torch.arange(SIZE * SIZE).unsqueeze(1).expand_as(after)
        info = {"state": state, "next_state": after}
        for name in ("upper", "lower", "lava"):
            info[name] = torch.tensor([[numbers[name] for _, numbers in row] for row in told])
        info["left"] = info["upper"] + info["lower"]
        steps = {
            "observation": torch.eye(SIZE * SIZE)[state],
            "action": torch.arange(len(MOVES)).expand_as(after),
            "reward": info["left"],
            "info": info,
        }
        is_end = torch.isin(torch.arange(SIZE * SIZE), torch.tensor(ENDS))
        start = (~is_end).float()
        terminal = torch.isin(after, torch.tensor(ENDS))
        listed = TensorDict(steps, after.shape)
        # The horizon is the steps after which an episode is truncated: never, here.
        return Table(listed, after, terminal, start / start.sum(), horizon=np.inf)

    def behaviours(self):
        """Optional: what the data show, in the shares of env.mixture; random actions without.

        Each is a table [states, actions] of probabilities, or a function like `wander`.
        """
        table, found = self.transition_table(), {"wander": wander}
        for name, wants in (("go/up", up), ("go/down", down)):
            advantages, _ = solve(table, wants(table.steps))
            found[name] = (advantages / 0.2).softmax(-1)  # mostly the best action, not always
        return found


def wander(step, generator):
    """A behaviour: what B environments show -> their B actions.

    Args:
        step: TensorDict [B] with "observation" [B, O], and the numbers in info as ("info", name).
        generator: Source of all randomness.
    """
    return torch.randint(len(MOVES), step.batch_size, generator=generator)


# A rater: segments [B, T] -> utility of each step, float [B, T].
def up(segments):
    """Soon, by the upper exit."""
    about = segments["info"]
    return about["upper"] - about["lower"] - about["lava"] - 0.05


def down(segments):
    """Soon, by the lower exit."""
    about = segments["info"]
    return about["lower"] - about["upper"] - about["lava"] - 0.05
