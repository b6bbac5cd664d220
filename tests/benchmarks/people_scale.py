"""What one million answers of people take, from a file to a judged set.

    python tests/benchmarks/people_scale.py --out FOLDER
    python tests/benchmarks/people_scale.py --out FOLDER --answers 100000 --raters 10000

Writes answers of people of two hidden groups about items with 64 features, one in ten of them
wrong, then runs ``popl-import`` (reading, checking, writing) and ``popl-train`` on linear rewards
(training and judging by people held out), each in a process of its own on one thread. Prints the
processor time and the most memory of each, and what held-out people are predicted with.
"""

import argparse
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scale import taken

ITEMS, FEATURES = 10_000, 64


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--answers", type=int, default=1_000_000)
    parser.add_argument("--raters", type=int, default=100_000)
    parser.add_argument("--profile", action="store_true", help="write FOLDER/<step>.profile too")
    parser.add_argument("overrides", nargs="*", help="further settings, such as method=em")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    write(given.out, given.answers, given.raters)
    imported, run_dir = given.out / "imported", given.out / "run"
    steps = {
        "import_data": [given.out / "said.csv", imported, f"items={given.out / 'items.npy'}"],
        "train_popl": ["raters=people", f"data.load={imported}", f"run_dir={run_dir}"],
    }
    # A person gives ten answers or so: some are told, the others judged by.
    steps["train_popl"] += ["method.hidden=[]", "people.least=4", "people.curve=[0,5]"]
    steps["train_popl"] += ["logger=csv", *given.overrides]
    for folder in (imported, run_dir):
        shutil.rmtree(folder, ignore_errors=True)
    for name, arguments in steps.items():
        profile = ["-m", "cProfile", "-o", str(given.out / f"{name}.profile")]
        command = [sys.executable, *(profile if given.profile else [])]
        command += ["-m", f"popl_rl.trainers.{name}", *map(str, arguments)]
        seconds, gib = taken(command, given.out / f"{name}.log")
        print(f"{name}: {seconds:.0f} s, {gib:.2f} GiB", flush=True)  # noqa: T201
    results = pd.read_csv(run_dir / "results.csv", keep_default_na=False)
    accuracy = results[results["measure"] == "accuracy@5"]
    print(accuracy[["method", "choice", "value"]].to_string(index=False))  # noqa: T201


def write(out: Path, answers: int, raters: int) -> None:
    """Write ``items.npy`` and ``said.csv``, a table of who prefers which of two items."""
    rng = np.random.default_rng(0)
    items = rng.normal(size=(ITEMS, FEATURES)).astype(np.float32)
    np.save(out / "items.npy", items)
    wants = rng.normal(size=(2, FEATURES)).astype(np.float32)
    value = items @ wants.T
    rater = rng.permutation(answers) % raters
    first = rng.integers(ITEMS, size=answers)
    second = (first + rng.integers(1, ITEMS, size=answers)) % ITEMS
    group = rater % 2
    answer = value[second, group] > value[first, group]
    answer ^= rng.random(answers) < 0.1
    table = {"rater": rater, "first": first, "second": second, "answer": answer.astype(int)}
    pd.DataFrame(table).to_csv(out / "said.csv", index=False)


if __name__ == "__main__":
    main()
