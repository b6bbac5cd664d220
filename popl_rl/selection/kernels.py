"""Kernels of lexicase selection on passes, compiled by numba (the extra ``fast``).

Each does what a row of calls of torch does elsewhere in this package, and gives the same to the
bit. None draws at random. Nothing here checks its arguments.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "fingerprints",
    "members",
    "mixed",
    "narrow",
    "pack",
    "places",
    "same_rows",
]

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


@njit(cache=True)
def fingerprints(words: Ints, factors: Ints) -> Ints:
    """Hash of each row: see `popl_rl.selection.behaviours.fingerprints`."""
    prints = np.empty(len(words), np.int64)
    for row in range(len(words)):
        word, total = words[row], np.int64(0)
        for i in range(len(factors)):
            total += (word[i] ^ ((word[i] >> 32) & 0xFFFFFFFF)) * factors[i]
        prints[row] = total
    return prints


@njit(cache=True)
def same_rows(flags: Bytes, some: Ints, others: Ints) -> bool:
    """Whether each of some rows equals the other one of its place."""
    for i in range(len(some)):
        one, other = flags[some[i]], flags[others[i]]
        differ = np.uint8(0)
        for case in range(len(one)):
            differ |= one[case] ^ other[case]
        if differ:
            return False
    return True


@njit(cache=True)
def pack(flags: Bytes) -> Bytes:
    """Eight rows of 0 and 1 in one row of bytes; the last member fills the last byte up."""
    members, cases = flags.shape
    packed = np.empty(((members + 7) // 8, cases), np.uint8)
    for byte in range(len(packed)):
        row, first, last = packed[byte], 8 * byte, members - 1
        # Written out, so that the loop over cases becomes vector instructions.
        a, b = flags[first], flags[min(first + 1, last)]
        c, d = flags[min(first + 2, last)], flags[min(first + 3, last)]
        e, f = flags[min(first + 4, last)], flags[min(first + 5, last)]
        g, h = flags[min(first + 6, last)], flags[min(first + 7, last)]
        for i in range(cases):
            low = np.uint8(a[i]) | np.uint8(b[i] << 1) | np.uint8(c[i] << 2) | np.uint8(d[i] << 3)
            high = (
                np.uint8(e[i] << 4)
                | np.uint8(f[i] << 5)
                | np.uint8(g[i] << 6)
                | np.uint8(h[i] << 7)
            )
            row[i] = low | high
    return packed


@njit(cache=True)
def mixed(packed: Bytes) -> Flags:
    """Cases that some members pass and others fail."""
    cases = packed.shape[1]
    some = np.zeros(cases, np.uint8)
    every = np.full(cases, 255, np.uint8)
    for row in packed:
        for case in range(cases):
            some[case] |= row[case]
            every[case] &= row[case]
    return (some > 0) & (every < 255)


@njit(cache=True)
def places(drawn: Ints, count: int, looked: Ints, num_cases: int) -> Ints:
    """Place of each of the last ``count`` draws, ``[step, selection]``, if no case is set aside."""
    steps, selections = drawn.shape
    found = np.empty((count, selections), np.int64)
    seen_by = np.zeros(num_cases, np.int64)  # the last selection, from 1, that drew the case
    for selection in range(selections):
        place = looked[selection]
        for step in range(steps):
            draw = drawn[step, selection]
            if step >= steps - count:
                place += seen_by[draw] != selection + 1
                found[step - steps + count, selection] = place
            seen_by[draw] = selection + 1
    return found


@njit(cache=True)
def narrow(
    packed: Bytes, bits: Bytes, cases: Ints, places: Ints, limit: int, num_set: Ints
) -> tuple[Ints, Ints]:
    """Filter pools in place; returns places of the last cases that removed a member, and sizes."""
    steps, selections = cases.shape
    depth, sizes = np.zeros(selections, np.int64), np.zeros(selections, np.int64)
    place = np.empty(len(bits), np.uint64)  # of the bytes of the pool that are not 0, and these
    pool, rest = np.empty(len(bits), np.uint8), np.empty(len(bits), np.uint8)
    for selection in range(selections):
        left = 0
        for byte in range(len(bits)):
            if bits[byte, selection]:
                place[left], pool[left] = byte, bits[byte, selection]
                left += 1
        for step in range(steps):
            alone = left == 1 and not pool[0] & (pool[0] - 1)
            if alone or places[step, selection] > limit:
                break
            case = np.uint64(cases[step, selection])
            kept = gone = np.uint8(0)
            for i in range(left):
                rest[i] = pool[i] & packed[place[i], case]
                kept |= rest[i]
                gone |= rest[i] ^ pool[i]
            if not kept or not gone:
                continue  # where nobody passes, everybody stays
            depth[selection] = places[step, selection]
            before, left = left, 0
            for i in range(before):
                pool[left], place[left] = rest[i], place[i]
                left += rest[i] > 0
        bits[:, selection] = 0
        for i in range(left):
            bits[place[i], selection] = pool[i]
            sizes[selection] += num_set[pool[i]]
    return depth, sizes


@njit(cache=True)
def members(bits: Bytes, selections: Ints, num_set: Ints) -> tuple[Ints, Ints]:
    """Position in ``selections`` and member of each pair, in the order of bytes."""
    count = 0
    for selection in selections:
        for byte in range(len(bits)):
            count += num_set[bits[byte, selection]]
    owner, member = np.empty(count, np.int64), np.empty(count, np.int64)
    count = 0
    for byte in range(len(bits)):
        for position in range(len(selections)):
            value = bits[byte, selections[position]]
            for bit in range(8):
                if value >> bit & 1:
                    owner[count], member[count] = position, 8 * byte + bit
                    count += 1
    return owner, member
