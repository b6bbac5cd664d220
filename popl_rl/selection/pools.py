"""Pools of members, narrowed case by case in many lexicase selections at once.

`PassPools` suits passes, `ScorePools` real scores; `popl_rl.selection.rounds.Round` drives either.
Nothing here checks its arguments.
"""

import torch
from torch import Tensor

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
        self.packed = _pack(self.scores)  # [member / 8, case]
        mixed = (self.packed.amax(0) > 0).logical_and_(self.packed.amin(0) < 255)
        self.cases = mixed.nonzero().view(-1)
        # After this many cases that half the members pass, one pool in 256 is still undecided.
        self.block = (len(passes) - 1).bit_length() + 8
        self.chunk = max(1, 2**24 // (self.block * len(self.packed)))
        bits = torch.arange(8, device=passes.device)
        self.set_bits = (torch.arange(256, device=passes.device)[:, None] >> bits) & 1
        self.num_set = self.set_bits.sum(1)

    def most(self, num_selections: int) -> int:
        """Longest block of draws that fits into memory."""
        return max(1, 2**24 // (num_selections * len(self.packed)))

    def open(self, num_selections: int) -> None:
        """Start this many selections, each with every member in its pool."""
        self.bits = self.packed.new_full((len(self.packed), num_selections), 255)
        self.bits[-1] >>= -len(self.scores) % 8  # no bit stands for no member

    def narrow(self, cases: Tensor, closed: Tensor | None) -> tuple[Tensor, int]:
        """Filter each pool by its cases in turn.

        Args:
            cases: Which case comes next, ``[step, selection]``.
            closed: Where the case does not count any more, ``[step, selection]``; None if nowhere.

        Returns:
            Where members were removed, ``[step, selection]``, and the nanoseconds it took.
        """
        steps, selections = cases.shape
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
        return narrowed, passed.numel()

    def sizes(self) -> Tensor:
        """Members left in each pool, ``[selection]``."""
        return self.num_set.take(self.bits.long()).sum(0)

    def keep(self, selections: Tensor) -> None:
        """Go on with the selections at these indices only."""
        self.bits = self.bits[:, selections]

    def members(self, selections: Tensor) -> tuple[Tensor, Tensor]:
        """List who is in these pools.

        Returns:
            Position in ``selections``, and member, of each pair, ``[pair]`` each.
        """
        bits = self.bits.index_select(1, selections)
        byte, owner = bits.nonzero().unbind(1)
        pair, bit = self.set_bits[bits[byte, owner].long()].nonzero().unbind(1)
        return owner.take(pair), 8 * byte.take(pair) + bit


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


class ScorePools:
    """Pools of members with real scores, as a list of (selection, member) pairs.

    Few members share the best score of a case, so these pools are small after the first one.

    Args:
        scores: ``[member, case]``, higher is better.
        epsilon: How far from the best of its pool a member may be; None means not at all.
    """

    block = 1

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

    def narrow(self, cases: Tensor, closed: Tensor | None) -> tuple[Tensor, int]:
        """Filter each pool by its case; see `PassPools.narrow`."""
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
        return (self.size < before)[None], 30 * values.numel()

    def _spread(self, by_selection: Tensor) -> Tensor:
        """Give each pair what belongs to its selection."""
        return by_selection if self.full else by_selection.gather(0, self.owner)

    def sizes(self) -> Tensor:
        """Members left in each pool, ``[selection]``."""
        return self.size

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
