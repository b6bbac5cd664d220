"""Processor time of whole runs beside that of plain torch for the gradient steps in them.

    python tests/benchmarks/runs.py --out FOLDER

Each run is a ``popl-train`` of its own on one thread, from start to report. The reference is
what Adam takes, in plain torch and in the same session, for as many CPL steps as the recipe gives
to all members together, of one network of theirs at a time: on drawn segments of the run's
length, with the recipe's batch size, from the observations on. Segments, clone and whatever else a
run finds ready are made before. Writes FOLDER/runs.csv.
"""

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
import yaml
from scale import taken
from torch import Tensor

from popl_rl.memory import keep_freed_memory
from popl_rl.models.policies import build_network
from popl_rl.models.sets import load_set

RUNS = {
    "two_doors": [],
    "hidden_utility": ["env=hidden_utility"],
    "drawer_open": ["env=metaworld/drawer_open"],
}
STEPS = 20  # of the reference that are timed, three times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--run", choices=RUNS, action="append", help="which; all if none is named")
    given = parser.parse_args()
    out: Path = given.out
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    keep_freed_memory()  # as runs do
    rows = []
    for name in given.run or RUNS:
        rows.append({"run": name, **measure(name, out)})
        print(pd.DataFrame(rows).tail(1).to_string(index=False), flush=True)  # noqa: T201
    pd.DataFrame(rows).to_csv(out / "runs.csv", index=False)


def measure(name: str, out: Path) -> dict[str, float]:
    """Processor time of a run, and of its reference before and after."""
    run_dir = out / name
    command = [sys.executable, "-m", "popl_rl.trainers.train_popl", *RUNS[name]]
    command += ["logger=csv", f"run_dir={run_dir}"]
    if name == "drawer_open":
        command.append(f"data.store={(out / 'segments').resolve()}")
        if not (out / "segments").is_dir():
            taken([*command, "evaluation.figures=false"], out / "first.log")
    shutil.rmtree(run_dir, ignore_errors=True)
    seconds, gib = taken(command, out / f"{name}.log")
    reference = plain_steps(run_dir)
    return {"seconds": seconds, "gib": gib, "plain": reference, "ratio": seconds / reference}


def plain_steps(run_dir: Path) -> float:
    """Seconds that plain torch takes for the CPL steps of all members of a run."""
    method = yaml.safe_load((run_dir / "config.yaml").read_text())
    length, method = method["data"]["length"], method["method"]
    training = method["training"]
    folder = next(one for one in ("policies", "rewards") if (run_dir / one).is_dir())
    spec: Any = load_set(run_dir / folder).population.spec
    generator = torch.Generator().manual_seed(0)
    network = build_network(spec, generator=generator)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    shape = 2, training["batch_size"], length
    observation = torch.randn(*shape, spec.observation_dim, generator=generator)
    action = torch.randn(*shape, spec.action_dim, generator=generator)
    if spec.discrete:
        action = torch.randint(spec.action_dim, shape, generator=generator)

    def step() -> Tensor:
        optimizer.zero_grad()
        preferred, other = spec.step_scores(network(observation), action).sum(-1)
        loss = -F.logsigmoid(training["alpha"] * (preferred - other)).mean()
        loss.backward()
        optimizer.step()
        return loss

    step()
    times = []
    for _ in range(3):
        start = time.process_time()
        for _ in range(STEPS):
            step()
        times.append(time.process_time() - start)
    return sorted(times)[1] / STEPS * training["steps"] * method["members"]


if __name__ == "__main__":
    main()
