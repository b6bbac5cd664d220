"""How long large scoring and selection take on a device, for a person who has a GPU.

    python tests/benchmarks/device.py --device cuda --out device.csv

Scores of 1000 whole networks, and of 1000 reward heads on features that are kept, on 10⁵ pairs of
segments; 1000 parents by lexicase selection from 10⁴ members on 10⁶ cases (10 GB of passes alone).
``--share 0.01`` takes a hundredth of the members, pairs and cases, and shows that it runs.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import torch

from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import segment_scores
from popl_rl.selection.lexicase import lexicase_selection

Run = Callable[[], object]
ROUNDS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1 or cpu")
    parser.add_argument("--share", type=float, default=1.0, help="of members, pairs and cases")
    parser.add_argument("--out", type=Path, required=True, help="file to write, a CSV")
    args = parser.parse_args()
    if not 0 < args.share <= 1:
        parser.error(f"--share must be above 0 and at most 1, got {args.share}")
    device = torch.device(args.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda needs a GPU that torch sees; --device cpu runs without")
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "processor"
    rows = []
    for work, prepare in WORK.items():
        seconds, gib = measure(prepare(device, args.share), device)
        row = {"work": work, "device": name, "share": args.share, "seconds": seconds, "gib": gib}
        rows.append(row)
        print(f"{work}: {seconds:.4g} s on {name}, share {args.share:g}")  # noqa: T201
    pd.DataFrame(rows).to_csv(args.out, index=False)


def whole_networks(device: torch.device, share: float) -> Run:
    """1000 networks 39-256-256-4 on segments of 64 steps."""
    spec = PolicySpec(39, 4, False, (256, 256))
    generator = torch.Generator().manual_seed(0)
    population = Population.create(spec, size(1000, share), generator=generator).to(device)
    bank = distinct_steps(size(200_000, share), 64, device)
    return lambda: segment_scores(population, bank)


def reward_heads(device: torch.device, share: float) -> Run:
    """1000 reward heads on 512 features of segments of 4 steps."""
    spec = RewardSpec(39, 1, (512, 512))
    generator = torch.Generator().manual_seed(0)
    members = size(1000, share)
    population = Population.create(spec, members, evolve="head", generator=generator).to(device)
    bank = distinct_steps(size(200_000, share), 4, device)
    bank = SegmentBank(bank.observation, bank.row, torch.zeros_like(bank.row), False)
    return lambda: segment_scores(population, bank, memory_mb=1024.0)


def selection(device: torch.device, share: float) -> Run:
    """1000 parents from random passes, all members distinct."""
    generator = torch.Generator(device).manual_seed(0)
    shape = (size(10_000, share), size(1_000_000, share))
    passes = torch.empty(shape, dtype=torch.bool, device=device).random_(generator=generator)
    return lambda: lexicase_selection(passes, 1000, generator=generator)


WORK: dict[str, Callable[[torch.device, float], Run]] = {
    "scores of 1000 whole networks on 100 000 pairs": whole_networks,
    "scores of 1000 reward heads (512 features) on 100 000 pairs": reward_heads,
    "1000 selections, 10 000 members x 1 000 000 passes": selection,
}


def size(full: int, share: float) -> int:
    return max(2, round(full * share))


def distinct_steps(segments: int, steps: int, device: torch.device) -> SegmentBank:
    """Segments of which no observation repeats, drawn on the processor: the same on any device."""
    generator = torch.Generator().manual_seed(1)
    return SegmentBank(
        torch.randn(segments * steps, 39, generator=generator),
        torch.arange(segments * steps).view(segments, steps),
        2 * torch.rand(segments, steps, 4, generator=generator) - 1,
        False,
    ).to(device)


def measure(run: Run, device: torch.device) -> tuple[float, float]:
    """Least time by the clock of three runs after a first one, and most memory of a GPU in GiB."""
    on_gpu = device.type == "cuda"
    times = []
    for _ in range(1 + ROUNDS):
        if on_gpu:
            torch.cuda.synchronize(device)
        start = time.perf_counter()
        run()
        if on_gpu:
            torch.cuda.synchronize(device)  # what was asked for is not yet done
        times.append(time.perf_counter() - start)
    gib = torch.cuda.max_memory_allocated(device) / 2**30 if on_gpu else float("nan")
    return min(times[1:]), gib


if __name__ == "__main__":
    main()
