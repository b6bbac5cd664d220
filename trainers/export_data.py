"""Write preferences for other programs, rater ids included: ``popl-export``.

popl-export runs/mine/data exported              # a folder with comparisons.csv and segments.csv
popl-export runs/mine/data exported.npz          # one npz file, as CPL publishes its data
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from popl_rl.trainers.command import USER_ERRORS
from popl_rl.trainers.terminal import steady_terminal

__all__ = ["cli", "main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Export; returns the exit code."""
    parser = argparse.ArgumentParser("popl-export", description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of segments and preferences")
    parser.add_argument("target", type=Path, help="folder for csv, or a file ending in .npz")
    given = parser.parse_args(arguments)
    try:
        if given.target.exists():
            raise FileExistsError(f"{given.target} exists; remove it or choose another path")
        from popl_rl.data.readers.writing import read_folder, write_csv, write_npz

        data = read_folder(given.data)
        if given.target.suffix == ".npz":
            write_npz(data, given.target)
        else:
            write_csv(data, given.target)
    except USER_ERRORS as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(f"{len(data.preferences)} comparisons written to {given.target}")
    return 0


def cli() -> None:
    """Console command ``popl-export``."""
    with steady_terminal():
        sys.exit(main())


if __name__ == "__main__":
    cli()
