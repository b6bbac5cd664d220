"""N policies, or reward functions, as one stack of parameters: score, clone, swap members."""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn

from popl_rl.policies import Spec, build_network
from popl_rl.rewards import RewardSpec
from popl_rl.segments import SegmentBank

__all__ = ["Layer", "Population", "activation", "segment_scores"]

# A CPU core multiplies fastest what stays in its cache from one layer to the next.
_ROWS = 1024  # observations looked at together
_BLOCK = 2**18  # outputs of a layer, over these observations and some members

#: Weight and bias of a linear layer, or what comes between two of them. Weights are ``[N, K, F]``,
#: or ``[K, F]`` where all members share one; biases ``[N, K]``, or ``[K]`` likewise.
Layer = tuple[Tensor, Tensor | None] | nn.Module


class Population(nn.Module):
    """Stacked policies, or reward functions, of one architecture.

    The layers of the members are multiplied together (``baddbmm``; heads as one matrix), which on
    a CPU is as fast as a loop over the members and faster than ``torch.vmap``; on a GPU it is one
    kernel per layer.

    Args:
        networks: One ``nn.Sequential`` of linear layers and element-wise activations per member.
        spec: Sizes the networks were built from.
        evolve: ``"all"``: every weight belongs to a member. ``"head"``: members differ in the last
            layer only; the layers before it are those of ``networks[0]``, shared and frozen.

    Attributes:
        trunk: Layers shared by all members; empty for ``evolve="all"``.
        members: The members' own parameters, a ``TensorDictParams`` of batch size ``[N]``.

    Raises:
        ValueError: If there are no networks or their architectures differ.
    """

    def __init__(
        self,
        networks: Sequence[nn.Sequential],
        spec: Spec,
        *,
        evolve: Literal["all", "head"] = "all",
    ) -> None:
        super().__init__()
        self.evolve: Literal["all", "head", "code"]
        if not networks:
            raise ValueError("networks must hold at least one network, got none")
        kinds = {str(network) for network in networks}
        if len(kinds) > 1:
            raise ValueError(
                f"networks must share one architecture, got {' and '.join(sorted(kinds))}; build "
                "them all from one spec"
            )
        if evolve not in ("all", "head"):
            raise ValueError(f"evolve must be 'all' or 'head', got {evolve!r}")
        split = len(networks[0]) - 1 if evolve == "head" else 0
        self.spec = spec
        self.evolve = evolve
        self.trunk = nn.Sequential(*list(networks[0])[:split]).requires_grad_(False)
        # Sequential(*...) rather than a slice: it numbers the layers from 0.
        own = [nn.Sequential(*list(network)[split:]) for network in networks]
        self.members: TensorDictParams = TensorDict.from_modules(*own, as_module=True)
        self._activations = [activation(layer) for layer in list(networks[0])[split:]]
        self._seen = _Seen()

    @classmethod
    def create(
        cls,
        spec: Spec,
        num_members: int,
        *,
        evolve: Literal["all", "head"] = "all",
        generator: torch.Generator,
    ) -> "Population":
        """Build ``num_members`` freshly initialised members."""
        if num_members < 1:
            raise ValueError(f"num_members must be at least 1, got {num_members}")
        networks = [build_network(spec, generator=generator) for _ in range(num_members)]
        return cls(networks, spec, evolve=evolve)

    def __len__(self) -> int:
        return int(self.members.batch_size[0])

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        device: torch.device = next(self.members.parameters()).device
        return device

    def forward(self, observation: Tensor) -> Tensor:
        """Logits, mean actions or rewards of every member.

        Args:
            observation: ``[R, O]`` seen by all members, or ``[N, R, O]``, each its own.

        Returns:
            ``[N, R, action_dim]``.
        """
        return self.from_features(self.trunk(observation))

    def from_features(self, features: Tensor) -> Tensor:
        """The members' own layers, applied to outputs of the trunk ``[R, F]`` or ``[N, R, F]``."""
        return _apply(self._layers(), features)

    def _layers(self) -> list[Layer]:
        layers: list[Layer] = []
        for position, activation in enumerate(self._activations):
            if activation is not None:
                layers.append(activation)
                continue
            layer = self.members[str(position)]
            layers.append((layer["weight"], layer.get("bias", None)))
        return layers

    def constrain_(self) -> None:
        """Put members that a step led out of bounds back, in place; whole networks have none."""

    @torch.no_grad()
    def replace_(self, parents: Tensor) -> None:
        """Overwrite the members by copies of ``parents`` ``[N]``, in place."""
        self.members.data.update_(self.members.data[parents].clone())

    def subset(self, indices: Tensor | Sequence[int]) -> "Population":
        """Copies of some members, in the order of ``indices``."""
        return self.with_members(self.members.data[torch.as_tensor(indices)].clone())

    def with_members(self, members: TensorDictBase) -> "Population":
        """A population of the same architecture with other parameters (taken, not copied)."""
        clone = Population.__new__(Population)
        nn.Module.__init__(clone)
        clone.spec, clone.evolve, clone.trunk = self.spec, self.evolve, self.trunk
        clone.members = TensorDictParams(members)
        clone._activations, clone._seen = self._activations, self._seen
        return clone

    def network(self, index: int) -> nn.Sequential:
        """Member ``index`` as an ordinary network with parameters of its own."""
        network = self._blank_network()
        split = len(self.trunk)
        network[:split].load_state_dict(self.trunk.state_dict())
        own = self.members.data[index].flatten_keys(".").to_dict()
        nn.Sequential(*list(network)[split:]).load_state_dict(own)
        return network

    def plain(self) -> "Population":
        """The same members as whole networks, or as heads on the same trunk: what can be saved."""
        return self

    def _blank_network(self) -> nn.Sequential:
        """A network of the members' architecture, whose weights say nothing yet."""
        generator = torch.Generator().manual_seed(0)
        return build_network(self.spec, generator=generator).to(self.device)


def activation(layer: nn.Module) -> nn.Module | None:
    """A layer's activation, or None for a linear layer."""
    if isinstance(layer, nn.Linear):
        return None
    # It follows a linear layer, whose output nobody else needs.
    return nn.ReLU(inplace=True) if isinstance(layer, nn.ReLU) else layer


def _apply(layers: Sequence[Layer], features: Tensor) -> Tensor:
    """Own layers of N members on features ``[R, F]`` or ``[N, R, F]``, ``[N, R, K]``."""
    hidden = features
    for layer in layers:
        if isinstance(layer, nn.Module):
            hidden = layer(hidden)
            continue
        weight, bias = layer
        if weight.ndim == 2:
            if bias is None or bias.ndim == 1:
                hidden = F.linear(hidden, weight, bias)
            else:
                hidden = F.linear(hidden, weight) + bias.unsqueeze(1)
            continue
        count = len(weight)
        if hidden.ndim == 2 and len(layers) == 1:
            # Heads on features they share: one product with all of them below each other.
            stack = weight.flatten(0, 1)
            if bias is None:
                product = stack @ hidden.T
            else:
                product = torch.addmm(bias.flatten().unsqueeze(1), stack, hidden.T)
            return product.view(count, -1, len(hidden)).mT
        if hidden.ndim == 2:
            hidden = hidden.expand(count, *hidden.shape)
        if bias is None:
            hidden = torch.bmm(hidden, weight.mT)
        else:
            hidden = torch.baddbmm(bias.unsqueeze(1), hidden, weight.mT)
    return hidden


class _Seen:
    """What a frozen trunk makes of one bank, kept from one scoring to the next.

    Shared by a population and its copies. Tensors of a bank are told by identity and version,
    and the trunk by its parameters: a changed one is looked through again.
    """

    def __init__(self) -> None:
        self._bank: tuple[Tensor, ...] = ()
        self._about: tuple[object, ...] = ()
        self._trunk: list[Tensor] = []
        self._value: Tensor | None = None

    def get(
        self,
        trunk: nn.Module,
        bank: SegmentBank,
        purpose: tuple[object, ...],
        make: Callable[[], Tensor],
    ) -> Tensor:
        """The tensor made for this trunk, bank and purpose, made now if it is not there."""
        tensors = (bank.observation, bank.row, bank.action)
        # Tensors made in inference mode keep no version; nor can autograd need them.
        versions = (None if tensor.is_inference() else tensor._version for tensor in tensors)
        about = (*purpose, *versions)
        if (
            self._value is None
            or about != self._about
            or any(one is not two for one, two in zip(tensors, self._bank, strict=True))
            or not all(map(_same, trunk.parameters(), self._trunk))
        ):
            self._value = None  # free it first
            self._value = make()
            self._bank, self._about = tensors, about
            self._trunk = [parameter.detach().clone() for parameter in trunk.parameters()]
        return self._value


def _same(one: Tensor, two: Tensor) -> bool:
    return one.device == two.device and one.dtype == two.dtype and torch.equal(one, two)


def _chunks(total: int, size: int) -> Iterator[slice]:
    for start in range(0, total, size):
        yield slice(start, min(start + size, total))


def _each(layers: Sequence[Layer], change: Callable[[Tensor], Tensor]) -> list[Layer]:
    """The same layers with other weights and biases."""
    changed: list[Layer] = []
    for layer in layers:
        if isinstance(layer, nn.Module):
            changed.append(layer)
        else:
            weight, bias = layer
            changed.append((change(weight), None if bias is None else change(bias)))
    return changed


def _some(layers: Sequence[Layer], part: slice) -> list[Layer]:
    """The layers of some members; what all members share stays as it is."""
    chosen: list[Layer] = []
    for layer in layers:
        if isinstance(layer, nn.Module):
            chosen.append(layer)
        else:
            weight, bias = layer
            own = weight[part] if weight.ndim == 3 else weight
            chosen.append((own, bias[part] if bias is not None and bias.ndim == 2 else bias))
    return chosen


@torch.no_grad()
def segment_scores(
    population: Population,
    bank: SegmentBank,
    *,
    alpha: float = 1.0,
    discount: float = 1.0,
    memory_mb: float = 256.0,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Score every segment once per member: ``S_n(sigma) = sum_t gamma^t alpha log pi_n(a_t|s_t)``.

    The score inside the CPL loss (arXiv 2310.13639, equation 5); for reward functions the sum of
    rewards, ``sum_t gamma^t alpha r_n(s_t, a_t)``.

    Observations that occur more than once in the bank are looked at once where actions are
    discrete, and by reward functions. What a frozen trunk makes of the bank is kept for the next
    call as long as it takes at most half of ``memory_mb``, else worked out again in chunks. Heads
    of reward functions are linear: they score a segment by the sum of its features.

    Args:
        population: N members.
        bank: The segments.
        alpha: Temperature of CPL's maximum-entropy policies.
        discount: Per-step discount gamma.
        memory_mb: Bound on the temporaries and on what is kept, in MiB, beside the result itself;
            work is cut into chunks that fit, down to one segment and one member.
        dtype: Precision in which the members' own layers are multiplied. ``torch.bfloat16`` pays
            on processors that multiply it in hardware (AMX, AVX-512 BF16, CUDA) and is many times
            slower on others; margins are off by some thousandths of their spread, so that
            nearly tied pairs may change sides. Sums over steps are float32 always.

    Returns:
        ``[N, num_segments]`` float32.
    """
    scoring = _Scoring(population, bank, discount, int(memory_mb * 2**18), dtype)
    scores = torch.empty(len(population), len(bank), device=population.device)
    if scoring.can_look_up():
        scoring.look_up(scores)
    elif len(scoring.layers) == 1 and isinstance(population.spec, RewardSpec):
        scoring.add_up(scores)
    else:
        scoring.walk(scores)
    return scores.mul_(alpha)


class _Scoring:
    """The three ways to score; ``numbers`` of four bytes may be used, half of them kept."""

    def __init__(
        self,
        population: Population,
        bank: SegmentBank,
        discount: float,
        numbers: int,
        dtype: torch.dtype,
    ) -> None:
        self.population, self.bank, self.dtype = population, bank, dtype
        self.spec, self.trunk = population.spec, population.trunk
        self.layers = _each(population._layers(), lambda tensor: tensor.to(dtype))
        self.numbers = numbers
        self.steps = bank.row.shape[1]
        self.discount = discount
        self.weight = discount ** torch.arange(self.steps, device=population.device).float()
        # Two or three results of a layer are alive at once, and as many of the trunk's.
        block = numbers // 32
        if population.device.type == "cpu":
            block = min(block, _BLOCK)
        spec = self.spec
        width = max(spec.observation_dim, *spec.hidden, spec.action_dim)
        self.rows = max(1, min(_ROWS, block // width))
        own = spec.action_dim if len(self.layers) == 1 else width
        self.members = max(1, block // (self.rows * own))

    def can_look_up(self) -> bool:
        """Whether scores of a member's every choice at every distinct observation fit."""
        cells = len(self.bank.observation) * self.spec.action_dim
        return self.spec.discrete and self.bank.is_shared and 8 * cells <= self.numbers

    def look_up(self, scores: Tensor) -> None:
        """Few distinct observations: a table of step scores answers for every step."""
        bank, spec, steps = self.bank, self.spec, self.steps
        distinct, choices = len(bank.observation), spec.action_dim
        features = self._features()
        for some in _chunks(len(scores), max(1, self.numbers // (8 * distinct * choices))):
            layers = _some(self.layers, some)
            count = len(scores[some])
            table = torch.empty(count, distinct, choices, device=scores.device)
            for rows in _chunks(distinct, self.rows):
                seen = self._see(rows, features)
                for members in _chunks(count, self.members):
                    output = _apply(_some(layers, members), seen)
                    table[members, rows] = spec.table(output.float())
            # Rows of all members' scores, added up over the steps of each segment.
            cells = table.flatten(1).T.contiguous()
            for part in _chunks(len(bank), max(1, self.numbers // (8 * (4 * steps + count)))):
                cell = bank.row[part] * choices + bank.action[part]
                weight = self.weight.expand(cell.shape).contiguous()
                scores[some, part] = F.embedding_bag(
                    cell, cells, mode="sum", per_sample_weights=weight
                ).T

    def add_up(self, scores: Tensor) -> None:
        """Heads linear in the features: add these up over the steps, then multiply once."""
        layer = self.layers[0]
        assert isinstance(layer, tuple)
        heads = layer[0].flatten(1)
        width = heads.shape[1]
        sums = None
        if len(self.bank) * width <= self.numbers // 2:
            sums = self._keep(("sums", self.discount), lambda: self._all_sums(width))
        size = max(1, self.rows // (1 if sums is not None else self.steps))
        for part in _chunks(len(self.bank), size):
            some = self._sums(part) if sums is None else sums[part]
            scores[:, part] = heads @ some.to(self.dtype).T

    def _all_sums(self, width: int) -> Tensor:
        sums = torch.empty(len(self.bank), width, device=self.weight.device)
        for part in _chunks(len(sums), max(1, self.rows // self.steps)):
            sums[part] = self._sums(part)
        return sums

    def _sums(self, part: slice) -> Tensor:
        """Discounted sums of features, apart for each choice, ``[P, K * F]``."""
        row, action = self.bank.row[part], self.bank.action[part]
        features: Tensor = self.trunk(self.bank.observation[row])
        chosen = F.one_hot(action, self.spec.action_dim) * self.weight.unsqueeze(1)
        return (chosen.mT @ features).flatten(1)

    def walk(self, scores: Tensor) -> None:
        """Look at every step of every segment."""
        bank, spec = self.bank, self.spec
        features = self._features()
        for part in _chunks(len(bank), max(1, self.rows // self.steps)):
            seen = self._see(bank.row[part].flatten(), features)
            action = bank.action[part].flatten(0, 1)
            for members in _chunks(len(scores), self.members):
                output = _apply(_some(self.layers, members), seen)
                value = spec.step_scores(output.float(), action).unflatten(1, (-1, self.steps))
                scores[members, part] = value @ self.weight

    def _features(self) -> Tensor | None:
        """The trunk's outputs at all distinct observations, if they may be kept."""
        if not len(self.trunk):
            return self.bank.observation
        width = self.spec.hidden[-1]
        if len(self.bank.observation) * width > self.numbers // 2:
            return None
        return self._keep(("features",), lambda: self._all_features(width))

    def _all_features(self, width: int) -> Tensor:
        observation = self.bank.observation
        features = torch.empty(len(observation), width, device=observation.device)
        for part in _chunks(len(features), self.rows):
            features[part] = self.trunk(observation[part])
        return features

    def _keep(self, purpose: tuple[object, ...], make: Callable[[], Tensor]) -> Tensor:
        return self.population._seen.get(self.trunk, self.bank, purpose, make)

    def _see(self, rows: slice | Tensor, features: Tensor | None) -> Tensor:
        """Features at these rows of the distinct observations."""
        seen = self.trunk(self.bank.observation[rows]) if features is None else features[rows]
        return seen.to(self.dtype)
