"""The check of an environment."""

from typing import Any

from popl_rl.data.environments import offered
from popl_rl.data.plugged import check_behaviours
from popl_rl.plug_ins import call
from popl_rl.testing.env_parts import (
    check_acting,
    check_repeats,
    check_spaces,
    check_table,
    check_torchrl,
    random_steps,
)
from popl_rl.testing.plug_ins import EnvReference, made_env, name_of

__all__ = ["check_env"]


def check_env(env: EnvReference, *, num_steps: int = 200, seed: int = 0, **arguments: Any) -> None:
    """Check that an environment can be used here; the first fault found is raised.

    Args:
        env: An environment, its factory, or a reference to the factory (see ``popl_rl.registry``).
        num_steps: Random steps to take.
        seed: Seed of episodes and actions.
        **arguments: Keyword arguments for the factory.

    Raises:
        TypeError: If spaces, observations, rewards or infos are of another kind than training can
            take; ``popl_rl.data.adapters`` says which.
        ValueError: If the environment fails, gives numbers that are not finite or observations of
            another shape than its space's, has nothing to act with, or has a transition table or
            behaviours that do not describe it.

    Warns:
        UserWarning: Of what training does not mind: episodes that a seed does not repeat,
            observations out of their space, behaviours that a generator does not repeat, and what
            TorchRL's own check finds.

    Example:
        >>> from popl_rl.testing import check_env, tiny_env
        >>> check_env(tiny_env)
    """
    name = name_of(env)
    with made_env(name, env, arguments) as made:
        check_spaces(name, made)
        steps = random_steps(name, made, num_steps, seed)
        check_repeats(name, steps, random_steps(name, made, num_steps, seed))
        if offered(made, "transition_table"):
            table = call("env", name, "transition_table", offered(made, "transition_table"))
            check_table(name, table, made, steps)
        if offered(made, "behaviours"):
            found = call("env", name, "behaviours", offered(made, "behaviours"))
            check_behaviours(name, found)
            if offered(made, "collect_segments") is None:
                check_acting(name, made, found, steps)
        check_torchrl(name, made)
