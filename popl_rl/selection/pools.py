"""Pools of members, narrowed case by case in many lexicase selections at once.

`PassPools` suits passes, `ScorePools` real scores; `popl_rl.selection.rounds.Round` drives either.
Nothing here checks its arguments.
"""

from functools import lru_cache

import torch
from torch import Tensor

from popl_rl.selection.compiled import kernels_for
from popl_rl.selection.epsilon import Epsilon

__all__ = ["PassPools", "ScorePools"]


class PassPools:
    """Pools of members that pass or fail each case: one bit per member and selection.

    A case then filters eight members with one byte operation.

    Args:
        passes: Who passes what, ``[member, case]``, bool.
    """

    epsilon = None

    def __init__(self, passes: Tensor) -> None:
        self.scores = passes.contiguous().view(torch.uint8)
        self.kernels = kernels_for(passes)
        if self.kernels is None:
            self.packed = _pack(self.scores)  # [member / 8, case]
            mixed = (self.packed.amax(0) > 0).logical_and_(self.packed.amin(0) < 255)
        else:
            self.packed = torch.from_numpy(self.kernels.pack(self.scores.numpy()))
            mixed = torch.from_numpy(self.kernels.mixed(self.packed.numpy()))
        self.cases = mixed.nonzero().view(-1)
        # After this many cases that half the members pass, one pool in 256 is still undecided.
        self.block = (len(passes) - 1).bit_length() + 8
        self.chunk = max(1, 2**24 // (self.block * len(self.packed)))
        self.set_bits, self.num_set = _bits_of_bytes(passes.device)
        self.last = 255 >> -len(passes) % 8  # of the last byte: no bit stands for no member

    def most(self, num_selections: int) -> int:
        """Longest block of draws that fits into memory."""
        return max(1, 2**24 // (num_selections * len(self.packed)))

    def open(self, num_selections: int) -> None:
        """Start this many selections, each with every member in its pool."""
        self.bits = self.packed.new_full((len(self.packed), num_selections), 255)
        self.bits[-1].fill_(self.last)

    def narrow(self, cases: Tensor, places: Tensor, limit: int) -> tuple[Tensor, Tensor, int]:
        """Filter each pool by its cases in turn.

        Args:
            cases: Which case comes next, ``[step, selection]``.
            places: Place of each in its selection's order, ``[step, selection]``.
            limit: Place of the last case that counts.

        Returns:
            Place of the last case that removed a member, 0 if none did, and members left in each
            pool, ``[selection]`` each, and the nanoseconds it took.
        """
        steps, selections = cases.shape
        if self.kernels is not None:
            pools, order = (self.packed.numpy(), self.bits.numpy()), (cases.numpy(), places.numpy())
            depth, sizes = self.kernels.narrow(*pools, *order, limit, self.num_set.numpy())
            work = cases.numel() * len(self.packed)
            return torch.from_numpy(depth), torch.from_numpy(sizes), work
        closed = _closed(places, limit, self.scores.shape[1])
        passed = self.packed.gather(1, cases.reshape(-1).expand(len(self.packed), -1))
        passed = passed.view(-1, steps, selections)
        history = [self.bits]
        for step, passes in enumerate(passed.unbind(1)):
            kept = self.bits & passes
            spared = kept.amax(0).logical_not_()  # where nobody passes, everybody stays
            if closed is not None:
                spared |= closed[step]
            self.bits = kept.bitwise_or_(self.bits * spared)
            history.append(self.bits)
        narrowed = torch.stack(history).diff(dim=0).amax(1) > 0
        sizes = self.num_set.take(self.bits.long()).sum(0)
        return (places * narrowed).amax(0), sizes, passed.numel()

    def keep(self, selections: Tensor) -> None:
        """Go on with the selections at these indices only."""
        self.bits = self.bits[:, selections]

    def members(self, selections: Tensor) -> tuple[Tensor, Tensor]:
        """List who is in these pools.

        Returns:
            Position in ``selections``, and member, of each pair, ``[pair]`` each.
        """
        if self.kernels is not None:
            who = (self.bits.numpy(), selections.numpy(), self.num_set.numpy())
            ends, ended = self.kernels.members(*who)
            return torch.from_numpy(ends), torch.from_numpy(ended)
        bits = self.bits.index_select(1, selections)
        byte, owner = bits.nonzero().unbind(1)
        pair, bit = self.set_bits[bits[byte, owner].long()].nonzero().unbind(1)
        return owner.take(pair), 8 * byte.take(pair) + bit


@lru_cache
def _bits_of_bytes(device: torch.device) -> tuple[Tensor, Tensor]:
    """Bits of each byte, ``[256, 8]``, and how many of them are set, ``[256]``."""
    bits = torch.arange(8, device=device)
    set_bits = (torch.arange(256, device=device)[:, None] >> bits) & 1
    return set_bits, set_bits.sum(1)


def _pack(flags: Tensor) -> Tensor:
    """Put eight rows of 0 and 1 into one row of bytes: ``[member, case] -> [member / 8, case]``."""
    packed = flags.new_empty(-(-len(flags) // 8), flags.shape[1])
    places = 2 ** torch.arange(8, dtype=torch.uint8, device=flags.device).unsqueeze(1)
    rows = max(1, 2**17 // flags.shape[1])  # so that a part stays in the processor's cache
    parts = zip(torch.split(packed, rows), torch.split(flags, 8 * rows), strict=True)
    for packed_part, part in parts:
        if len(part) % 8:
            # The last member fills the byte up: unlike zeros it splits no case by itself.
            part = torch.cat([part, part[-1:].expand(-len(part) % 8, -1)])
        packed_part.copy_((part.view(-1, 8, part.shape[1]) * places).sum(1, dtype=torch.uint8))
    return packed


def _closed(places: Tensor, limit: int, num_cases: int) -> Tensor | None:
    """Where a case does not count any more, ``[step, selection]``; None if nowhere."""
    return places > limit if limit < num_cases else None


class ScorePools:
    """Pools of members with real scores, as a list of (selection, member) pairs.

    Few members share the best score of a case, so these pools are small after the first one.

    Args:
        scores: ``[member, case]``, higher is better.
        epsilon: How far from the best of its pool a member may be; None means not at all.
    """

    block = 1
    kernels = None

    def __init__(self, scores: Tensor, epsilon: Epsilon | None) -> None:
        self.scores = scores.contiguous()
        self.epsilon = epsilon
        few = scores[:8]  # mostly enough to see that members differ on every case
        mixed = (few != few[0]).any(0)
        if not mixed.all():
            mixed = scores.amin(0) < scores.amax(0)
        self.cases = mixed.nonzero().view(-1)
        self.chunk = max(1, 2**22 // len(scores))
        floating = scores.dtype.is_floating_point
        self.lowest = -torch.inf if floating else torch.iinfo(scores.dtype).min

    def most(self, num_selections: int) -> int:  # noqa: ARG002
        """Longest block of draws: one case leaves so few that a second might go to waste."""
        return 1

    def open(self, num_selections: int) -> None:
        """Start this many selections, each with every member in its pool."""
        self.full = True  # and no need to list everybody
        self.owner = self.member = self.cases.new_empty(0)
        self.size = self.cases.new_full((num_selections,), len(self.scores))

    def narrow(self, cases: Tensor, places: Tensor, limit: int) -> tuple[Tensor, Tensor, int]:
        """Filter each pool by its case; see `PassPools.narrow`."""
        closed = _closed(places, limit, self.scores.shape[1])
        case = cases[0]
        if self.full:
            values = self.scores.gather(1, case.expand(len(self.scores), -1))
            best = values.amax(0)
        else:
            place = self.member * self.scores.shape[1] + case.gather(0, self.owner)
            values = self.scores.view(-1).gather(0, place)
            best = values.new_full(case.shape, self.lowest)
            best.scatter_reduce_(0, self.owner, values, "amax")
        bar = best if self.epsilon is None else best - self.epsilon.at(case)
        kept = values >= self._spread(bar)
        if closed is not None:
            kept |= self._spread(closed[0])
        if self.full:
            self.member, self.owner = kept.nonzero().unbind(1)
            self.full = False
        else:
            stay = kept.nonzero().view(-1)
            self.member, self.owner = self.member.gather(0, stay), self.owner.gather(0, stay)
        before, self.size = self.size, self.owner.bincount(minlength=len(case))
        return places[0] * (self.size < before), self.size, 30 * values.numel()

    def _spread(self, by_selection: Tensor) -> Tensor:
        """Give each pair what belongs to its selection."""
        return by_selection if self.full else by_selection.gather(0, self.owner)

    def keep(self, selections: Tensor) -> None:
        """Go on with the selections at these indices only."""
        self.owner, self.member = self.members(selections)
        self.size = self.size[selections]

    def members(self, selections: Tensor) -> tuple[Tensor, Tensor]:
        """Who is in these pools; see `PassPools.members`."""
        position = self.owner.new_full(self.size.shape, -1)
        position[selections] = torch.arange(len(selections), device=position.device)
        owner = position.gather(0, self.owner)
        wanted = (owner >= 0).nonzero().view(-1)
        return owner.gather(0, wanted), self.member.gather(0, wanted)
