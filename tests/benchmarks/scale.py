"""How time and memory of a whole run grow with raters, comparisons or members.

    python tests/benchmarks/scale.py raters --out FOLDER
    python tests/benchmarks/scale.py comparisons --out FOLDER --most 1000000
    python tests/benchmarks/scale.py members --out FOLDER --world two_doors

Each size is a ``popl-train`` of its own on one thread, from start to report: processor time, the
most memory it held, and how well the worst-served group is served. Writes FOLDER/AXIS-WORLD.csv
and prints a table with the powers in which time and memory grow from size to size. Of members it
also says which share of a generation selection takes.
"""

import argparse
import math
import os
import pstats
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd

SIZES = {
    "raters": [100, 1000, 10_000, 100_000],
    "comparisons": [10_000, 100_000, 1_000_000, 10_000_000],
    "members": [32, 64, 128, 256, 512, 1024],
}
# What takes time that no member, rater or comparison has a part in.
COMMON = ["logger=csv", "evaluation.animate=false", "evaluation.history=0"]
WORLDS = {
    "hidden_utility": ["env=hidden_utility", "evaluation.reward_baselines=false"],
    "two_doors": [],
}
SHARE = {"hidden_utility": "worst_recovery", "two_doors": "worst_share_of_optimum"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("axis", choices=SIZES)
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--world", choices=WORLDS, default="hidden_utility")
    parser.add_argument("--least", type=int, default=0, help="no smaller sizes")
    parser.add_argument("--most", type=int, default=sys.maxsize, help="no larger sizes")
    parser.add_argument("overrides", nargs="*", help="further settings, such as method.generations")
    given = parser.parse_args()
    rows: list[dict[str, float]] = []
    for size in SIZES[given.axis]:
        if given.least <= size <= given.most:
            rows.append(measure(given.axis, given.world, size, given.out, given.overrides))
            table = growth(pd.DataFrame(rows))
            table.to_csv(given.out / f"{given.axis}-{given.world}.csv", index=False)
            print(table.tail(1).to_string(index=False, header=len(rows) == 1), flush=True)  # noqa: T201


def measure(axis: str, world: str, size: int, out: Path, overrides: list[str]) -> dict[str, float]:
    """Run one size in a process of its own."""
    run_dir = out / f"{axis}-{world}-{size}"
    shutil.rmtree(run_dir, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    settings = {
        "raters": [f"raters.count={size}", "raters.answers=10"],
        "comparisons": [f"raters.answers={size // 200}", "raters.count=200", f"data.memmap={out}"],
        "members": [f"method.members={size}"],
    }[axis]
    profile = ["-m", "cProfile", "-o", str(out / "profile")] if axis == "members" else []
    command = [sys.executable, *profile, "-m", "popl_rl.trainers.train_popl", *WORLDS[world]]
    command += [*COMMON, *settings, *overrides, f"run_dir={run_dir}"]
    seconds, gib = taken(command, out / f"{run_dir.name}.log")
    results = pd.read_csv(run_dir / "results.csv", keep_default_na=False)
    own = (results["method"] == "popl") & (results["choice"] == "posterior")
    reached = results[own & (results["measure"] == SHARE[world])]["value"].item()
    row = {
        axis: size,
        "seconds": seconds,
        "gib": gib,
        SHARE[world]: float(reached),
    }
    return row | ({"selection": selection_share(out / "profile")} if profile else {})


def taken(command: list[str], log: Path) -> tuple[float, float]:
    """Processor time in seconds and the most memory in GiB of a process on one thread."""
    with log.open("w") as file:
        child = subprocess.Popen(
            command, stdout=file, stderr=file, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(command)} failed, see {log}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20


def selection_share(profile: Path) -> float:
    """Share of the generations' time that goes into selecting parents."""
    stats = pstats.Stats(str(profile)).stats  # type: ignore[attr-defined]
    total = {"lexicase_given_first": 0.0, "step": 0.0}
    for (file, _, name), (*_, cumulative, _) in stats.items():
        if (Path(file).name, name) in (
            ("lexicase.py", "lexicase_given_first"),
            ("popl.py", "step"),
        ):
            total[name] += cumulative
    return total["lexicase_given_first"] / total["step"]


def growth(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the powers in which time and memory have grown since the size before."""
    size = table.columns[0]
    for column in ("seconds", "gib"):
        larger = table[size] / table[size].shift()
        table[f"{column}^"] = (table[column] / table[column].shift()).map(math.log) / larger.map(
            math.log
        )
    return table.round(3)


if __name__ == "__main__":
    main()
