"""The order of cases in lexicase selection: which case comes next, and when a selection is over.

`popl_rl.selection.pools` holds the members that are left. Nothing here checks its arguments.
"""

import torch
from torch import Tensor

from popl_rl.selection.pools import PassPools, ScorePools

__all__ = ["Round"]

# Work is measured in nanoseconds as seen on one CPU core. The figures decide only when a round
# stops drawing cases blindly, so they touch the speed, never the result.
BLOCK_NS = 200_000  # the fixed cost of one block of draws
SORT_NS = 60  # finding one draw among the earlier ones
SETTLE_NS = 150_000  # the fixed cost of settling one selection


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

    def select(self, num_selected: int, first: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Select behaviours.

        Args:
            num_selected: Selections.
            first: Case that each selection's order begins with, ``[num_selected]``; random if None.

        Returns:
            The behaviour chosen by each selection, and the place in its order of the last case
            that removed a member (0 if none did), ``[num_selected]`` each.
        """
        self.depth = self.weights.new_zeros(num_selected)
        self.ended: list[tuple[Tensor, Tensor]] = []  # (selection, behaviour) pairs
        selections = torch.arange(num_selected, device=self.device)
        if len(self.pools.cases):
            for part in torch.split(selections, self.pools.chunk):
                self._run(part, None if first is None else first[part])
        else:
            everyone = torch.arange(len(self.weights), device=self.device)
            owner = selections.repeat_interleave(len(everyone))
            self.ended.append((owner, everyone.repeat(num_selected)))
        return self._choose(num_selected), self.depth

    def _run(self, selections: Tensor, first: Tensor | None) -> None:
        """Take these selections from full pools to their end, all together."""
        pools, cases = self.pools, self.pools.cases
        pools.open(len(selections))
        looked = torch.zeros_like(selections)  # length of the order so far
        skipped = looked  # how much of it is cases on which all members agree
        depth = looked
        drawn = selections.new_empty(0, len(selections))
        if first is not None:
            drawn, skipped = self._place_of(first)
            looked = torch.ones_like(selections)
            depth = pools.narrow(first[None], looked[None], self.limit)[0]
        spent, landmark = 0.0, torch.inf
        length = pools.block
        while True:
            shape = (length, len(selections))
            draws = torch.randint(len(cases), shape, generator=self.generator, device=self.device)
            drawn = torch.cat([drawn, draws])
            places, skipped = self._places(drawn, draws, looked, skipped)
            looked = places[-1]
            found, sizes, work = pools.narrow(cases.take(draws), places, self.limit)
            depth = torch.maximum(depth, found)

            done = (sizes == 1).logical_or_(looked >= self.limit)
            over = done.nonzero().view(-1)
            if ending := len(over):
                owner, member = pools.members(over)
                ended = selections.take(over)
                self.ended.append((ended.take(owner), member))
                self.depth[ended] = depth.take(over)
                if ending == len(selections):
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
            elif spent >= self.settling_work(len(selections), pairs):
                break
        owner, member = pools.members(torch.arange(len(selections), device=self.device))
        members = torch.split(member[owner.argsort(stable=True)], sizes.tolist())
        self.depth[selections] = depth
        for selection, place, pool in zip(selections, looked.tolist(), members, strict=True):
            self._settle(selection, place, pool)

    def _place_of(self, first: Tensor) -> tuple[Tensor, Tensor]:
        """Given cases as draws, ``[1, selection]``, and whether they are aside, ``[selection]``."""
        cases = self.pools.cases
        place = torch.searchsorted(cases, first).clamp(max=len(cases) - 1)
        aside = cases[place] != first
        # No draw is -1: nothing that comes later is the same case.
        return place.masked_fill(aside, -1)[None], aside.long()

    def _places(
        self, drawn: Tensor, draws: Tensor, looked: Tensor, skipped: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Place of each draw in its selection's order of all cases, ``[step, selection]``.

        A case drawn again takes no new place. The cases that were set aside because they split
        nobody stand in the order too, between the draws.
        """
        aside = self.num_cases - len(self.pools.cases)
        kernels = self.pools.kernels
        if kernels is not None and not aside:
            places = kernels.places(drawn.numpy(), len(draws), looked.numpy(), self.num_cases)
            return torch.from_numpy(places), skipped
        ordered, order = drawn.sort(dim=0, stable=True)  # equal draws side by side, the first first
        fresh = torch.ones_like(drawn, dtype=torch.bool)
        fresh = fresh.scatter_(0, order[1:], ordered[1:] != ordered[:-1])[-len(draws) :]
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

    def settling_work(self, num_selections: int, pairs: int) -> float:
        """Nanoseconds of settling these selections, whose pools hold ``pairs`` members in all."""
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
