"""A behaviour-cloned network that is told, by a short code, in which style to act.

Contrastive preference learning moves whole networks away from the data: on long segments it ranks
well and then fails the task. A *style clone* is trained once on all segments, without preferences:
an encoder looks at the actions of a segment and gives it a code, and a decoder acts as the segment
does, from the observation and that code. Then it is frozen, and a policy is a code: whatever its
code, it stays near what the data shows, as in latent-variable behaviour cloning (Lynch et al.,
2020, arXiv 1903.01973; the codes' prior and the weight of its divergence are those of a
beta-variational autoencoder, Higgins et al., 2017).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from tensordict import TensorDict
from torch import Tensor, nn

from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.schedules import linear_decay
from popl_rl.optim import adam, take_step
from popl_rl.storage import load_tensordict, read_manifest, save_tensordict

__all__ = ["StyleClone", "load_clone", "save_clone", "train_clone"]

_BLOCK = 50  # steps between two changes of the learning rate, and two reports of progress
_LEAST_STD = 1e-2  # an observation that hardly ever changes is not blown up


class StyleClone(nn.Module):
    """A frozen decoder, and the codes that the data has.

    Args:
        spec: Sizes of the policies; the decoder has the same, and D more inputs.
        codes: Code of each segment, ``[N, D]``. Members stay within the range of the middle 94 %
            of them in each dimension: beyond, the decoder has seen too little.
        network: The decoder, ``[..., O + D] -> [..., A]``; freshly initialised if None.

    Attributes:
        low: Least value of each dimension of a member's code, ``[D]``.
        high: Greatest value, ``[D]``.
    """

    codes: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, spec: PolicySpec, codes: Tensor, network: nn.Sequential | None = None
    ) -> None:
        super().__init__()
        self.spec = spec
        if network is None:
            network = build_network(_decoder_spec(spec, codes.shape[1]), generator=_nothing())
        self.network = network.requires_grad_(False)
        edges = torch.quantile(codes, torch.tensor([0.03, 0.97], device=codes.device), dim=0)
        self.register_buffer("codes", codes)
        self.register_buffer("low", edges[0])
        self.register_buffer("high", edges[1])

    def first_layer(self) -> tuple[Tensor, Tensor, Tensor]:
        """Weights of observation ``[H, O]`` and code ``[H, D]``, and bias ``[H]``."""
        layer = self.network[0]
        assert isinstance(layer, nn.Linear)
        seen, told = layer.weight.split([self.spec.observation_dim, self.codes.shape[1]], dim=1)
        return seen, told, layer.bias

    def typical(self) -> Tensor:
        """The middle of the data's codes, ``[D]``: cloning without any preference."""
        return self.codes.median(0).values.clamp(self.low, self.high)

    def draw(self, count: int, *, generator: torch.Generator) -> Tensor:
        """Codes of randomly drawn segments, ``[count, D]``."""
        device = self.codes.device
        row = torch.randint(len(self.codes), (count,), generator=generator, device=device)
        return self.codes[row].clamp(self.low, self.high)


def train_clone(
    spec: PolicySpec,
    bank: SegmentBank,
    *,
    code_dim: int = 2,
    steps: int = 3000,
    batch_size: int = 256,
    looks: int = 16,
    learning_rate: float = 1e-3,
    beta: float = 1e-3,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
) -> StyleClone:
    """Clone the behaviour of all segments, with a style code for each.

    The encoder sees actions alone, at random steps of the segment: what a code can say is how
    things are done, not where or how far along.

    Args:
        spec: Sizes of the policies.
        bank: N segments.
        code_dim: Length D of a code. Dimensions that are not needed are left empty by the prior.
        steps: Gradient steps.
        batch_size: Segments per step.
        looks: Steps of a segment that the encoder sees, and as many others that are cloned.
        learning_rate: Adam's step size, held for half of the steps, then falling to zero.
        beta: Weight of the codes' divergence from N(0, I), against the log-likelihood of a step.
        generator: Source of initial weights, batches and codes.
        progress: Called with the number of steps done.

    Returns:
        The clone, frozen.

    Raises:
        ValueError: If a count is not positive or ``beta`` is negative.
    """
    counts = {"code_dim": code_dim, "steps": steps, "batch_size": batch_size, "looks": looks}
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if not beta >= 0:
        raise ValueError(f"beta must be at least 0, got {beta}")
    decoder = build_network(_decoder_spec(spec, code_dim), generator=generator)
    encoder = _Encoder(spec, code_dim, generator=generator)
    device = bank.row.device
    decoder, encoder = decoder.to(device), encoder.to(device)
    mean = bank.observation.mean(0)
    std = bank.observation.std(0).clamp(min=_LEAST_STD)
    optimizer = adam([*decoder.parameters(), *encoder.parameters()], lr=learning_rate)
    schedule = linear_decay(optimizer, -(-steps // _BLOCK))
    length = bank.row.shape[1]

    def draw(high: int, *shape: int) -> Tensor:
        return torch.randint(high, shape, generator=generator, device=device)

    for done in range(1, steps + 1):
        segment = draw(len(bank), batch_size, 1)
        seen, cloned = draw(length, batch_size, looks), draw(length, batch_size, looks)
        centre, log_var = encoder(bank.action[segment, seen])
        noise = torch.randn(centre.shape, generator=generator, device=device)
        code = centre + noise * (log_var / 2).exp()
        observation = (bank.observation[bank.row[segment, cloned]] - mean) / std
        told = code.unsqueeze(1).expand(-1, looks, -1)
        output = decoder(torch.cat([observation, told], -1))
        likelihood = spec.step_scores(output, bank.action[segment, cloned]).mean()
        divergence = (centre.square() + log_var.exp() - 1 - log_var).sum(-1).mean() / 2
        loss = beta * divergence - likelihood
        take_step(optimizer, loss)
        if done % _BLOCK == 0 or done == steps:
            schedule.step()
            if progress is not None:
                progress(done)
    with torch.no_grad():
        codes = torch.cat([encoder(action)[0] for action in bank.action.split(256)])
        # Scaling observations is a matter of the first layer's weights.
        first = decoder[0]
        assert isinstance(first, nn.Linear)
        weight = first.weight[:, : spec.observation_dim]
        weight.div_(std)
        first.bias.sub_(weight @ mean)
    return StyleClone(spec, codes, decoder)


class _Encoder(nn.Module):
    """Actions ``[B, L]`` or ``[B, L, A]`` in any order to mean and log-variance ``[B, D]``."""

    def __init__(self, spec: PolicySpec, code_dim: int, *, generator: torch.Generator) -> None:
        super().__init__()
        self.spec = spec
        inner, outer = (
            PolicySpec(size, width, False, (64,))
            for size, width in ((spec.action_dim, 64), (64, 2 * code_dim))
        )
        self.each = build_network(inner, generator=generator)
        self.all = build_network(outer, generator=generator)

    def forward(self, action: Tensor) -> Sequence[Tensor]:
        if self.spec.discrete:
            action = F.one_hot(action, self.spec.action_dim).float()
        code: Tensor = self.all(self.each(action).relu().mean(1))
        return code.chunk(2, dim=-1)


def save_clone(clone: StyleClone, path: Path, *, bank: str | None = None) -> None:
    """Write a clone as tensors; nothing is left half-written.

    Args:
        clone: The clone.
        path: The folder to be.
        bank: Digest of what it was trained on, which is kept.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    state = dict(clone.network.state_dict())
    data = TensorDict({"codes": clone.codes, "network": TensorDict(state)})
    save_tensordict(data, path, about={"bank": bank})


def load_clone(spec: PolicySpec, path: Path, *, bank: str | None = None) -> StyleClone:
    """Read what ``save_clone`` wrote.

    Args:
        spec: Sizes of the policies.
        path: The folder.
        bank: Digest of what it must have been trained on; None for whatever it was.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged, of other sizes, or was trained on something else.
    """
    data = load_tensordict(path, required={"codes": 2})
    manifest = read_manifest(path)
    kept = None if manifest is None else manifest["about"].get("bank")
    if None not in (kept, bank) and kept != bank:
        raise ValueError(
            f"{path} holds a style clone of other segments; remove it to train one anew"
        )
    clone = StyleClone(spec, data["codes"])
    try:
        clone.network.load_state_dict(data["network"].to_dict())
    except (KeyError, RuntimeError) as error:
        raise ValueError(
            f"{path} holds a style clone of other sizes ({error}); remove it to train one anew"
        ) from error
    return clone


def _decoder_spec(spec: PolicySpec, code_dim: int) -> PolicySpec:
    return replace(spec, observation_dim=spec.observation_dim + code_dim)


def _nothing() -> torch.Generator:
    """For weights that are overwritten at once."""
    return torch.Generator().manual_seed(0)
