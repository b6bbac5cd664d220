"""The engine behind lexicase selection: pools of members, narrowed in many selections at once.

`PassPools` and `ScorePools` hold the pools and filter them by a case; `Round` decides which case
comes next in each selection and when a selection is over. Nothing here checks its arguments.
"""

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "Epsilon",
    "PassPools",
    "Round",
    "ScorePools",
    "median_absolute_deviation",
    "select_dynamically",
]

# Work is measured in nanoseconds as seen on one CPU core. The figures decide only when a round
# stops drawing cases blindly, so they touch the speed, never the result.
BLOCK_NS = 200_000  # the fixed cost of one block of draws
SORT_NS = 60  # finding one draw among the earlier ones
SETTLE_NS = 150_000  # the fixed cost of settling one selection


class Epsilon:
    """Tolerance per case: given, or the median absolute deviation, worked out where it is needed.

    Args:
        values: The tolerances, ``[case]``; NaN where the deviation is to be worked out.
        scores: Scores of all members, ``[member, case]``, for the deviation.
    """

    def __init__(self, values: Tensor, scores: Tensor) -> None:
        self.values = values
        self.scores = scores
        self.missing = int(values.isnan().sum())

    def at(self, cases: Tensor) -> Tensor:
        """Tolerances of the cases at these indices, in their shape."""
        if self.missing:
            wanted = torch.unique(cases)
            wanted = wanted[self.values[wanted].isnan()]
            for part in torch.split(wanted, max(1, 2**22 // len(self.scores))):
                columns = self.scores.gather(1, part.expand(len(self.scores), -1))
                self.values[part] = median_absolute_deviation(columns)
            self.missing -= len(wanted)
        return self.values[cases]


def median_absolute_deviation(values: Tensor) -> Tensor:
    """Median distance from the median of each column: ``[member, case] -> [case]``."""
    values = values.detach().T.contiguous()
    return _median((values - _median(values)[:, None]).abs_())


def _median(values: Tensor) -> Tensor:
    """Median of each row, the mean of the two middle values if there are two."""
    count, middle = values.shape[1], values.shape[1] // 2
    if values.device.type == "cpu":  # NumPy partitions several times faster than torch
        ordered = torch.from_numpy(np.partition(values.numpy(), middle, axis=1))
        lower = ordered[:, : max(1, middle)].amax(1)
    else:
        ordered = values.sort(dim=1).values
        lower = ordered[:, max(0, middle - 1)]
    upper = ordered[:, middle]
    return upper if count % 2 else (lower + upper) / 2


def select_dynamically(
    scores: Tensor, labels: Tensor, num_selected: int, *, limit: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Select members with a tolerance that is worked out anew in each pool, one after the other.

    Neither merging nor drawing cases twice is exact here: how many share a score, and how often a
    case is met, both matter.

    Args:
        scores: ``[member, case]``, floating.
        labels: Number of each member's behaviour, ``[member]``.
        num_selected: Parents to select.
        limit: Cases that each selection may look at.
        generator: Source of the case orders and of the tie breaks.

    Returns:
        The member chosen by each selection and its depth, ``[num_selected]`` each.
    """
    device = scores.device
    parents = torch.empty(num_selected, dtype=torch.long, device=device)
    depths = torch.zeros_like(parents)
    everyone = torch.arange(len(scores), device=device)
    several = bool((labels != labels[0]).any())
    for selection in range(num_selected):
        pool = everyone
        if several:
            order = torch.randperm(scores.shape[1], generator=generator, device=device)[:limit]
            for depth, case in enumerate(order.tolist(), start=1):
                values = scores[pool, case]
                tolerance = median_absolute_deviation(values[:, None])
                stay = values >= values.amax() - tolerance
                if bool(stay.all()):
                    continue
                pool = pool[stay]
                depths[selection] = depth
                if bool((labels[pool] == labels[pool[0]]).all()):
                    break
        draw = torch.randint(len(pool), (), generator=generator, device=device)
        parents[selection] = pool[draw]
    return parents, depths


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


class Round:
    """One round of selections among behaviours.

    Args:
        pools: The behaviours' scores, in the form that suits them.
        weights: Members that share each behaviour, ``[behaviour]``.
        limit: Cases that each selection may look at.
        generator: Source of the case orders and of the tie breaks.
    """

    def __init__(
        self,
        pools: PassPools | ScorePools,
        weights: Tensor,
        *,
        limit: int,
        generator: torch.Generator,
    ) -> None:
        self.pools = pools
        self.weights = weights
        self.limit = limit
        self.generator = generator
        self.device = weights.device
        self.num_cases = pools.scores.shape[1]
        self.known: dict[tuple[int, ...], Tensor] = {}
        self.room = 2**22  # how many numbers ``known`` may still take up

    def select(self, num_selected: int) -> tuple[Tensor, Tensor]:
        """Select behaviours.

        Returns:
            The behaviour chosen by each selection, and the place in its order of the last case
            that removed a member (0 if none did), ``[num_selected]`` each.
        """
        self.depth = self.weights.new_zeros(num_selected)
        self.ended: list[tuple[Tensor, Tensor]] = []  # (selection, behaviour) pairs
        selections = torch.arange(num_selected, device=self.device)
        if len(self.pools.cases):
            for part in torch.split(selections, self.pools.chunk):
                self._run(part)
        else:
            everyone = torch.arange(len(self.weights), device=self.device)
            owner = selections.repeat_interleave(len(everyone))
            self.ended.append((owner, everyone.repeat(num_selected)))
        return self._choose(num_selected), self.depth

    def _run(self, selections: Tensor) -> None:
        """Take these selections from full pools to their end, all together."""
        pools, cases = self.pools, self.pools.cases
        pools.open(len(selections))
        looked = torch.zeros_like(selections)  # length of the order so far
        skipped = looked  # how much of it is cases on which all members agree
        depth = looked
        drawn = selections.new_empty(0, len(selections))
        spent, landmark = 0.0, torch.inf
        length = pools.block
        while True:
            shape = (length, len(selections))
            draws = torch.randint(len(cases), shape, generator=self.generator, device=self.device)
            drawn = torch.cat([drawn, draws])
            places, skipped = self._places(drawn, draws, looked, skipped)
            looked = places[-1]
            closed = places > self.limit if self.limit < self.num_cases else None
            narrowed, work = pools.narrow(cases.take(draws), closed)
            depth = torch.maximum(depth, (places * narrowed).amax(0))

            sizes = pools.sizes()
            done = (sizes == 1).logical_or_(looked >= self.limit)
            over = done.nonzero().view(-1)
            if len(over):
                owner, member = pools.members(over)
                ended = selections.take(over)
                self.ended.append((ended.take(owner), member))
                self.depth[ended] = depth.take(over)
                if len(over) == len(selections):
                    return
                left = (~done).nonzero().view(-1)
                pools.keep(left)
                selections, depth, sizes = selections[left], depth[left], sizes[left]
                looked, skipped, drawn = looked[left], skipped[left], drawn[:, left]

            # Draw on while the pools shrink. When they stop, go on only until the draws have cost
            # as much as settling would: then the total is never far from the cheaper of the two.
            pairs = int(sizes.sum())
            spent += work + SORT_NS * drawn.numel() + BLOCK_NS
            length = min(2 * length, pools.most(len(selections)))
            if pairs <= landmark / 2:
                spent, landmark = 0.0, pairs
            elif spent >= self._settling_work(len(selections), pairs):
                break
        owner, member = pools.members(torch.arange(len(selections), device=self.device))
        members = torch.split(member[owner.argsort(stable=True)], sizes.tolist())
        self.depth[selections] = depth
        for selection, place, pool in zip(selections, looked.tolist(), members, strict=True):
            self._settle(selection, place, pool)

    def _places(
        self, drawn: Tensor, draws: Tensor, looked: Tensor, skipped: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Place of each draw in its selection's order of all cases, ``[step, selection]``.

        A case drawn again takes no new place. The cases that were set aside because they split
        nobody stand in the order too, between the draws.
        """
        ordered, order = drawn.sort(dim=0, stable=True)  # equal draws side by side, the first first
        fresh = torch.ones_like(drawn, dtype=torch.bool)
        fresh = fresh.scatter_(0, order[1:], ordered[1:] != ordered[:-1])[-len(draws) :]
        aside = self.num_cases - len(self.pools.cases)
        if not aside:
            return looked + fresh.cumsum(0), skipped
        places = torch.empty_like(draws)
        for step in range(len(draws)):
            unseen = len(self.pools.cases) - (looked - skipped)
            gap = self._gap(unseen, aside - skipped) * fresh[step]
            skipped = skipped + gap
            looked = looked + gap + fresh[step]
            places[step] = looked
        return places, skipped

    def _gap(self, wanted: Tensor, others: Tensor) -> Tensor:
        """Draw how many of ``others`` stand before the first of ``wanted`` in a random order.

        Give each case a uniform time of arrival; the first of n arrives at 1 - U ** (1 / n).
        """
        first = 1 - self._uniform(*wanted.shape) ** (1 / wanted)
        return torch.binomial(others.double(), first, generator=self.generator).long()

    def _settling_work(self, num_selections: int, pairs: int) -> float:
        work = SETTLE_NS * num_selections + 0.5 * pairs * self.num_cases
        if self.pools.epsilon is not None:
            work += 30.0 * self.pools.epsilon.missing * len(self.pools.epsilon.scores)
        return work

    def _settle(self, selection: Tensor, looked: int, pool: Tensor) -> None:
        """Finish one selection by drawing only cases that split its pool.

        None of them has been in the order yet: whom a case has kept, it would keep again.
        """
        scores, epsilon = self.pools.scores, self.pools.epsilon
        while True:
            cases = self._splitting(pool)
            if not len(cases):
                break
            counts = torch.tensor([len(cases), self.num_cases - looked - len(cases)])
            looked += 1 + int(self._gap(*counts.to(self.device)))
            if looked > self.limit:
                break
            self.depth[selection] = looked
            draw = torch.randint(len(cases), (), generator=self.generator, device=self.device)
            case = cases[draw]
            values = scores[pool, case]
            bar = values.amax() if epsilon is None else values.amax() - epsilon.at(case)
            pool = pool[values >= bar]
        self.ended.append((selection.expand(len(pool)), pool))

    def _splitting(self, pool: Tensor) -> Tensor:
        """Cases that would remove someone from this pool."""
        key = tuple(pool.tolist())
        if key in self.known:
            return self.known[key]
        rows = self.pools.scores[pool]
        bar = rows.amax(0)
        if self.pools.epsilon is not None:
            bar -= self.pools.epsilon.at(torch.arange(self.num_cases, device=self.device))
        cases = (rows.amin(0) < bar).nonzero().view(-1)
        if len(cases) + len(key) <= self.room:  # selections often end in the same few pools
            self.known[key] = cases
            self.room -= len(cases) + len(key)
        return cases

    def _choose(self, num_selected: int) -> Tensor:
        """Draw one behaviour of the pool each selection ended with, by the members behind it."""
        owner = torch.cat([owner for owner, _ in self.ended])
        member = torch.cat([member for _, member in self.ended])
        if len(member) == num_selected:  # nothing to draw: each pool is down to one
            return torch.empty_like(member).scatter_(0, owner, member)
        order = owner.argsort(stable=True)
        member = member[order]
        mass = self.weights[member].cumsum(0)
        end = mass[owner.bincount().cumsum(0) - 1]
        start = torch.cat([end.new_zeros(1), end[:-1]])
        ticket = start + (self._uniform(num_selected) * (end - start)).long()
        return member[torch.searchsorted(mass, ticket, right=True)]

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.device, dtype=torch.float64)
