"""Policy networks and TorchRL actors, built from an environment's spaces."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

from popl_rl.data.adapters import is_image, native_spaces
from popl_rl.data.bank import SegmentBank
from popl_rl.data.behaviours import first_action
from popl_rl.data.features import extractor, feature_source
from popl_rl.keys import ACTION, OBSERVATION
from popl_rl.models.convolutions import image_layers

__all__ = ["CategoricalFrom", "PolicySpec", "Spec", "build_actor", "build_network", "log_prob"]


class Spec(Protocol):
    """What a population has to know of its members: policies, or reward functions.

    Attributes:
        observation_dim: Length O of an observation vector.
        action_dim: Number K of outputs of a network.
        hidden: Units of each hidden layer.
        discrete: Whether an action is a choice of one among the ``action_dim`` outputs.
        output_bias: Whether the last layer has a bias.
        refines: Whether POPL's last training has been tried for this kind.
    """

    @property
    def observation_dim(self) -> int: ...  # noqa: D102
    @property
    def action_dim(self) -> int: ...  # noqa: D102
    @property
    def hidden(self) -> tuple[int, ...]: ...  # noqa: D102
    @property
    def discrete(self) -> bool: ...  # noqa: D102
    @property
    def output_bias(self) -> bool: ...  # noqa: D102
    @property
    def refines(self) -> bool: ...  # noqa: D102

    def table(self, output: Tensor) -> Tensor:
        """What choosing each of the outputs adds to a segment's score, ``[..., K]``."""
        ...

    def step_scores(self, output: Tensor, action: Tensor) -> Tensor:
        """What a step with this action adds to a segment's score, ``[...]``."""
        ...

    def conservatism(self, value: float) -> float:
        """Lambda of the CPL loss for this kind of hypotheses, where the recipe says ``value``."""
        ...

    def cloning(self, value: float) -> float:
        """Weight of behaviour cloning for this kind of hypotheses, where the recipe says so."""
        ...

    def bank(self, segments: TensorDictBase) -> SegmentBank:
        """Segments ``[N, T]`` as hypotheses of this kind read them."""
        ...


@dataclass(frozen=True)
class PolicySpec:
    """Everything needed to rebuild a policy network.

    Attributes:
        observation_dim: Length O of an observation vector.
        action_dim: Number of actions if ``discrete``, else the length A of an action vector.
        discrete: Whether actions are a choice of one among ``action_dim``.
        hidden: Units of each hidden layer. Empty for a linear policy.
        action_std: Standard deviation of the Gaussian of a continuous policy. The default makes
            its log-density ``-|mu(s) - a|^2`` up to a constant, the form CPL uses (arXiv
            2310.13639, section 4). Unused when ``discrete``.
        first_action: Action of the environment that the first output stands for, the start of its
            ``Discrete`` space. Data that policies learn from are counted from 0 all the same.
        image: Shape of an observation before it was flattened, ``(H, W, C)`` or ``(C, H, W)``,
            where the network begins with convolutions; else empty.
        channels: Outputs of each convolution, see ``popl_rl.models.convolutions``.
        image_scale: What pixels are divided by.
        features: Reference of the frozen extractor whose features are observed, see
            ``popl_rl.data.features``; empty without one.
        shown: Shape of what it reads; empty without one.
    """

    observation_dim: int
    action_dim: int
    discrete: bool
    hidden: tuple[int, ...] = (64, 64)
    action_std: float = 0.5**0.5
    first_action: int = 0
    image: tuple[int, ...] = ()
    channels: tuple[int, ...] = ()
    image_scale: float = 1.0
    features: str = ""
    shown: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name in ("observation_dim", "action_dim"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if any(units < 1 for units in self.hidden):
            raise ValueError(f"hidden must hold layer widths of at least 1, got {self.hidden}")
        if not self.action_std > 0:
            raise ValueError(f"action_std must be positive, got {self.action_std}")
        if bool(self.image) != bool(self.channels):
            raise ValueError(
                f"image and channels must both be given or neither, got {self.image} and "
                f"{self.channels}"
            )
        if self.image and (len(self.image) != 3 or prod(self.image) != self.observation_dim):
            raise ValueError(
                f"image must be three numbers whose product is observation_dim "
                f"({self.observation_dim}), got {self.image}"
            )
        if self.image and not self.hidden:
            raise ValueError("hidden must have at least one layer behind convolutions, got none")

    @classmethod
    def from_env(
        cls,
        env: gymnasium.Env[Any, Any],
        *,
        hidden: Sequence[int] = (64, 64),
        action_std: float = 0.5**0.5,
        channels: Sequence[int] = (),
    ) -> "PolicySpec":
        """Read the sizes off a Gymnasium environment's spaces.

        Args:
            env: An environment that ``popl_rl.data.adapters`` has adapted.
            hidden: Units of each hidden layer.
            action_std: Standard deviation of a continuous policy.
            channels: Outputs of each convolution, for environments whose observations were images;
                unused elsewhere.

        Raises:
            TypeError: If observations are not a flat ``Box`` or actions neither ``Discrete`` nor a
                flat ``Box``.
        """
        observation, action = env.observation_space, env.action_space
        if not isinstance(observation, gymnasium.spaces.Box) or len(observation.shape) != 1:
            raise TypeError(
                f"observation_space must be a Box of one dimension, got {observation}; flatten it, "
                "for example with gymnasium.wrappers.FlattenObservation"
            )
        if isinstance(action, gymnasium.spaces.Discrete):
            size, discrete = int(action.n), True
        elif isinstance(action, gymnasium.spaces.Box) and len(action.shape) == 1:
            size, discrete = action.shape[0], False
        else:
            raise TypeError(
                f"action_space must be Discrete or a Box of one dimension, got {action}"
            )
        first = first_action(action)
        spec = cls(observation.shape[0], size, discrete, tuple(hidden), action_std, first)
        features, shown = feature_source(env)
        spec = replace(spec, features=features, shown=shown)
        native = native_spaces(env)[0]
        if not channels or not is_image(native):
            return spec
        high = float(np.max(native.high))  # type: ignore[attr-defined]
        scale = high if 0 < high < np.inf else 1.0
        shape = tuple(int(length) for length in native.shape or ())
        return replace(spec, image=shape, channels=tuple(channels), image_scale=scale)

    def seen(self, observation: Tensor) -> Tensor:
        """Features of what the environment shows, as the networks read them.

        Args:
            observation: ``[..., *shown]``, such as images ``[..., H, W, C]`` uint8.

        Returns:
            ``[..., O]``; what is given where there is no extractor.

        Raises:
            ValueError: If the shape is another, the extractor cannot be found, or it gives features
                of another length.
        """
        if not self.features:
            return observation
        if observation.shape[-len(self.shown) :] != self.shown:
            raise ValueError(
                f"observation must have shape [..., {', '.join(map(str, self.shown))}], as the "
                f"environment shows it, got {list(observation.shape)}"
            )
        try:
            extract = extractor(self.features)
        except ValueError as error:
            raise ValueError(
                f"these policies act on {self.observation_dim} features, whose extractor cannot be "
                f"found: {error} Bring it back, or give them features"
            ) from error
        before = observation.shape[: observation.ndim - len(self.shown)]
        read = extract(observation.reshape(-1, *self.shown).cpu()).to(observation.device)
        if read.shape[1] != self.observation_dim:
            raise ValueError(
                f"features {self.features!r} must be {self.observation_dim} numbers, as when these "
                f"policies were trained, got {read.shape[1]}"
            )
        return read.view(*before, -1)

    @property
    def refines(self) -> bool:
        """Whether POPL's last training has been tried for this kind of hypotheses."""
        return True

    @property
    def output_bias(self) -> bool:
        """The last layer has a bias: it says which action is likely anywhere."""
        return True

    def table(self, output: Tensor) -> Tensor:
        """Log-probabilities of discrete actions, ``[..., K]``."""
        return output.log_softmax(-1)

    def step_scores(self, output: Tensor, action: Tensor) -> Tensor:
        """Log-probabilities of actions, ``[...]``; see ``log_prob``."""
        return log_prob(self, output, action)

    def conservatism(self, value: float) -> float:
        """As the recipe says: it keeps policies near the data."""
        return value

    def cloning(self, value: float) -> float:
        """As the recipe says."""
        return value

    def bank(self, segments: TensorDictBase) -> SegmentBank:
        """Observations and actions as they are."""
        return SegmentBank.from_segments(segments)


def build_network(spec: Spec, *, generator: torch.Generator) -> nn.Sequential:
    """Build one network, ``[..., O] -> [..., K]`` (logits, mean action, or rewards).

    Args:
        spec: Sizes of the network.
        generator: Source of the initial weights.

    Returns:
        The layers of a TorchRL ``MLP`` with ReLU activations, behind convolutions if there are
        any; these want observations ``[..., R, O]``.
    """
    seed = int(torch.randint(2**62, (), generator=generator, device=generator.device))
    # torch.nn initialises from the global generator only, so lend it a seed of ours.
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)  # of nothing else, which takes half the time
        # Of policies alone: reward functions read an observation with an action behind it.
        before, features = list[nn.Module](), spec.observation_dim
        if isinstance(spec, PolicySpec) and spec.image:
            before, features = image_layers(spec.image, spec.channels, scale=spec.image_scale)
        layers = MLP(
            in_features=features,
            out_features=spec.action_dim,
            num_cells=list(spec.hidden),
            activation_class=nn.ReLU,
            bias_last_layer=spec.output_bias,
        )
    # A plain Sequential, because an MLP cannot be sliced into trunk and head.
    return nn.Sequential(*before, *layers)


class CategoricalFrom(Categorical):
    """A categorical distribution over the actions of ``Discrete(n, start)``.

    Args:
        logits: ``[..., n]``.
        first: The start.
    """

    def __init__(self, logits: Tensor, *, first: int) -> None:
        super().__init__(logits=logits)  # type: ignore[no-untyped-call]
        self.first = first

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:  # type: ignore[override]
        """Actions ``[*sample_shape, ...]``."""
        drawn: Tensor = super().sample(torch.Size(sample_shape))  # type: ignore[no-untyped-call]
        return self.first + drawn

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability of actions ``[...]``."""
        chosen: Tensor = super().log_prob(value - self.first)  # type: ignore[no-untyped-call]
        return chosen

    @property
    def mode(self) -> Tensor:
        """The most likely action, ``[...]``."""
        return self.first + self.logits.argmax(-1)

    @property
    def deterministic_sample(self) -> Tensor:
        """What TorchRL takes where it does not explore: the mode."""
        return self.mode

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> "CategoricalFrom":
        """The same distribution for a larger batch."""
        logits = self.logits.expand(*batch_shape, self.logits.shape[-1])
        return CategoricalFrom(logits, first=self.first)


class _AnyBatch(nn.Module):
    """A network of observations ``[R, O]``, for those of any batch size."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        output: Tensor = self.network(observation.reshape(-1, observation.shape[-1]))
        return output.view(*observation.shape[:-1], -1)


def build_actor(spec: PolicySpec, network: nn.Module) -> ProbabilisticActor:
    """Wrap a network ``[..., O] -> [..., K]`` as a TorchRL actor.

    It reads ``observation`` and writes ``action`` as the environment takes it, ``[...]`` if
    discrete, else ``[..., A]``.
    """
    if spec.image:
        network = _AnyBatch(network)
    if spec.discrete:
        module = TensorDictModule(network, in_keys=[OBSERVATION], out_keys=["logits"])
        if spec.first_action == 0:
            return ProbabilisticActor(module, in_keys=["logits"], distribution_class=Categorical)
        return ProbabilisticActor(
            module,
            in_keys=["logits"],
            distribution_class=CategoricalFrom,
            distribution_kwargs={"first": spec.first_action},
        )

    class Gaussian(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
            mean = self.network(observation)
            return mean, torch.full_like(mean, spec.action_std)

    module = TensorDictModule(Gaussian(), in_keys=[OBSERVATION], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal, out_keys=[ACTION]
    )


def log_prob(spec: PolicySpec, output: Tensor, action: Tensor) -> Tensor:
    """Log-probability of actions under network outputs.

    Args:
        spec: Kind of policy.
        output: Logits or mean actions, ``[..., action_dim]``.
        action: Actions, ``[...]`` int64 if discrete, else ``[..., A]``; broadcast to ``output``.

    Returns:
        ``[...]``. For continuous policies without the Gaussian's constant, which is the same for
        every policy and cancels in every comparison of segments of equal length.
    """
    if spec.discrete:
        chosen = action.expand(output.shape[:-1]).unsqueeze(-1)
        return output.log_softmax(-1).gather(-1, chosen).squeeze(-1)
    return -(output - action).square().sum(-1) / (2 * spec.action_std**2)
