"""From a reward function to behaviour where no table can be planned in: PPO, with TorchRL's parts.

A learnt reward is known up to what preferences can tell. Segments of equal length say nothing about
a constant per step, so where an episode can end, whether ending it pays is not theirs to say: mind
the offset of a reward learnt from returns before it is maximised there.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer, SamplerWithoutReplacement, TensorStorage
from torchrl.modules import RunningValueNorm, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from popl_rl.evaluation.ppo_episodes import (
    Ending,
    RewardFunction,
    roll_episodes,
    running_returns,
)
from popl_rl.keys import ACTION, OBSERVATION, REWARD
from popl_rl.models.policies import PolicySpec, build_actor, build_network
from popl_rl.models.population import Population
from popl_rl.models.reward_set import RewardSet

__all__ = ["reward_of", "train_ppo"]

_LOG_PROB = "log_prob"
_ADVANTAGE = "advantage"


def reward_of(rewards: RewardSet, member: int) -> RewardFunction:
    """One reward function of a set, as ``train_ppo`` takes it.

    Args:
        rewards: Reward functions.
        member: Which.

    Returns:
        Maps steps ``[...]`` with ``observation`` and ``action``, counted from 0, to rewards.

    Raises:
        IndexError: If there is no such member.
    """
    if not 0 <= member < len(rewards):
        raise IndexError(f"member must be in 0..{len(rewards) - 1}, got {member}")
    own = rewards.subset([member])
    device = own.population.device

    def reward(steps: TensorDictBase) -> Tensor:
        flat = steps.flatten()
        observation, action = flat[OBSERVATION], flat[ACTION]
        if action.is_floating_point():
            joined = torch.cat([observation, action], -1).to(device)
            gain = own.reward(joined)[0]
        else:
            gain = own.reward(observation.to(device))[0].cpu().gather(-1, action.unsqueeze(-1))
        return gain.cpu().view(steps.batch_size)

    return reward


def train_ppo(
    make_env: Callable[[], gymnasium.Env[Any, Any]],
    reward: RewardFunction,
    spec: PolicySpec,
    *,
    frames: int = 100_000,
    frames_per_batch: int = 2048,
    num_envs: int = 32,
    max_steps: int,
    tells: bool = False,
    discount: float = 0.97,
    gae_lambda: float = 0.95,
    clip_epsilon: float = 0.2,
    entropy: float = 0.05,
    epochs: int = 6,
    minibatch: int = 512,
    learning_rate: float = 3e-3,
    generator: torch.Generator,
    progress: Callable[[int, float], None] | None = None,
) -> Population:
    """Train a policy on a reward function, by PPO with clipped ratios (arXiv 1707.06347).

    Whole episodes are collected in lockstep. One that ends by ``max_steps``, or that the
    environment truncates, is valued as if it went on; one that the environment terminates is over.

    A reward has an arbitrary scale, so rewards are divided by the running standard deviation
    of the discounted returns (arXiv 2005.12729, section 3). They are not shifted: a constant per
    step decides whether it pays to end an episode.

    Args:
        make_env: Builds one environment.
        reward: What is maximised: maps episodes ``[E, H]`` to the reward of each step, ``[E, H]``,
            as the utility of a rater group does. It sees actions within the bounds of the action
            space, and after an episode's end its last step again.
        spec: Architecture of the policy; it must be that of the environment. The critic has the
            same hidden layers.
        frames: Least number of steps in the environments; the last batch is completed.
        frames_per_batch: Least number of steps between two updates; episodes are completed.
        num_envs: Environments that advance together.
        max_steps: Steps after which an episode is cut.
        tells: Whether ``reward`` reads the environment's own rewards and infos, which are 0 and
            empty otherwise.
        discount: Factor of the next step's reward relative to this one's.
        gae_lambda: Decay of the generalised advantage estimate (arXiv 1506.02438): 0 trusts the
            critic, 1 what happened.
        clip_epsilon: How far a ratio of probabilities may leave 1 before it gains nothing more.
        entropy: Weight of the entropy bonus at the start; it falls linearly to 0. Nothing for a
            continuous policy, whose standard deviation is fixed.
        epochs: Passes over each batch.
        minibatch: Steps in each gradient step.
        learning_rate: Adam's step size at the start; it falls linearly to 0.
        generator: Source of initial weights, starts, actions and minibatches, on the CPU.
        progress: Called after each batch with the number of frames so far and the mean
            undiscounted return of the batch's episodes, in units of ``reward``.

    Returns:
        A population of one, the trained policy.

    Raises:
        ValueError: If a number is out of its range, ``spec`` is not that of the environment, or
            ``reward`` gives another shape or a value that is not finite.
        TypeError: If the environment's spaces are of another kind than
            ``popl_rl.models.policies.PolicySpec.from_env`` takes, or ``reward`` gives no
            floating-point tensor.
    """
    _check_numbers(
        counts={
            "frames": frames,
            "frames_per_batch": frames_per_batch,
            "num_envs": num_envs,
            "max_steps": max_steps,
            "epochs": epochs,
            "minibatch": minibatch,
        },
        shares={"discount": discount, "gae_lambda": gae_lambda},
        sizes={"clip_epsilon": clip_epsilon, "learning_rate": learning_rate},
        entropy=entropy,
    )
    network = build_network(spec, generator=generator)
    learner = _Learner(
        spec,
        network,
        discount=discount,
        gae_lambda=gae_lambda,
        clip_epsilon=clip_epsilon,
        learning_rate=learning_rate,
        generator=generator,
    )
    envs = [Ending(make_env(), tells=tells) for _ in range(num_envs)]
    try:
        _check_spec(spec, envs[0])
        act = partial(_act, spec, network, generator=generator)
        done = 0
        while done < frames:
            batch = _roll_batch(envs, act, reward, frames_per_batch, max_steps, generator)
            returned = float(batch["next", REWARD].sum() / batch["next", "done"].sum())
            learner.anneal(1 - done / frames, entropy)
            learner.update(batch, epochs, minibatch)
            done += len(batch)
            if progress is not None:
                progress(done, returned)
    finally:
        for env in envs:
            env.close()
    return Population([network], spec)


def _roll_batch(
    envs: Sequence[Ending],
    act: Callable[[TensorDictBase], Tensor],
    reward: RewardFunction,
    frames: int,
    max_steps: int,
    generator: torch.Generator,
) -> TensorDict:
    """Whole episodes of at least this many steps, ``[S]``."""
    rolled: list[TensorDict] = []
    while sum(map(len, rolled)) < frames:
        rolled.append(roll_episodes(envs, act, reward, max_steps=max_steps, generator=generator))
    batch: TensorDict = TensorDict.cat(rolled)
    return batch


class _Learner:
    """Actor, critic and optimiser, which learn from one batch of steps after the other."""

    def __init__(
        self,
        spec: PolicySpec,
        network: nn.Sequential,
        *,
        discount: float,
        gae_lambda: float,
        clip_epsilon: float,
        learning_rate: float,
        generator: torch.Generator,
    ) -> None:
        self.discount, self.learning_rate = discount, learning_rate
        self.generator = generator
        self.actor = build_actor(spec, network)
        value = PolicySpec(spec.observation_dim, 1, discrete=False, hidden=spec.hidden)
        critic = ValueOperator(build_network(value, generator=generator), in_keys=[OBSERVATION])
        self.advantage = GAE(
            gamma=discount, lmbda=gae_lambda, value_network=critic, deactivate_vmap=True
        )
        self.loss = ClipPPOLoss(
            self.actor,
            critic,
            clip_epsilon=clip_epsilon,
            entropy_coeff=0.0,  # set for each batch
            critic_coeff=0.5,
            loss_critic_type="l2",
            log_explained_variance=False,
            functional=False,
        )
        self.loss.set_keys(sample_log_prob=_LOG_PROB)
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=learning_rate, eps=1e-5, fused=True
        )
        self.returns = RunningValueNorm(shape=1, epsilon=1e-16)

    def value(self, batch: TensorDict) -> None:
        """Scale rewards, and add log-probabilities and advantages to a batch ``[S]``, in place.

        Args:
            batch: Steps of whole episodes, one episode after the other.
        """
        gain, over = batch["next", REWARD], batch["next", "done"]
        self.returns.update(running_returns(gain.squeeze(-1), over.squeeze(-1), self.discount))
        batch["next", REWARD] = gain / self.returns.scale()
        with torch.no_grad():
            self.advantage(batch)
            batch[_LOG_PROB] = self.actor.get_dist(batch).log_prob(batch[ACTION])
        # Here and not by the loss, whose last minibatch may be a single step.
        centred = batch[_ADVANTAGE] - batch[_ADVANTAGE].mean()
        batch[_ADVANTAGE] = centred / centred.square().mean().sqrt().clamp(min=1e-8)

    def anneal(self, left: float, entropy: float) -> None:
        """Scale step size and entropy bonus by the share of the frames that is left."""
        self.loss.entropy_coeff.fill_(entropy * left)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate * left

    def update(self, batch: TensorDict, epochs: int, minibatch: int) -> None:
        """Take gradient steps on minibatches of a batch ``[S]``, in passes over all of it.

        Args:
            batch: Steps of whole episodes, one episode after the other.
            epochs: Passes over the batch.
            minibatch: Steps in each gradient step.
        """
        self.value(batch)
        buffer = ReplayBuffer(
            storage=TensorStorage(batch.exclude("next")),
            sampler=SamplerWithoutReplacement(),
            batch_size=minibatch,
            generator=self.generator,
        )
        for _ in range(epochs):
            for some in buffer:
                terms = self.loss(some)
                total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
                self.optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
                self.optimizer.step()


def _check_numbers(
    *,
    counts: Mapping[str, int],
    shares: Mapping[str, float],
    sizes: Mapping[str, float],
    entropy: float,
) -> None:
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
    for name, share in shares.items():
        if not 0 <= share <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {share}")
    for name, size in sizes.items():
        if not 0 < size < float("inf"):
            raise ValueError(f"{name} must be positive, got {size}")
    if not 0 <= entropy < float("inf"):
        raise ValueError(f"entropy must be 0 or positive, got {entropy}")


def _check_spec(spec: PolicySpec, env: gymnasium.Env[Any, Any]) -> None:
    fits = PolicySpec.from_env(env, hidden=spec.hidden, action_std=spec.action_std)
    if fits != spec:
        raise ValueError(
            f"spec must be that of the environment, {fits}, got {spec}; use PolicySpec.from_env"
        )


@torch.no_grad()
def _act(
    spec: PolicySpec, network: nn.Module, step: TensorDictBase, *, generator: torch.Generator
) -> Tensor:
    """Sample actions; TorchRL's actors draw from the global generator only."""
    output: Tensor = network(step[OBSERVATION])
    if spec.discrete:
        return torch.multinomial(output.softmax(-1), 1, generator=generator).squeeze(-1)
    return output + spec.action_std * torch.randn(output.shape, generator=generator)
