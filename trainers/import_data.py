"""Bring preferences of real people into this library's format: ``popl-import``.

popl-import comparisons.csv my_data items=items.csv
popl-import pairs.npz my_data
popl-import dialogues.jsonl my_data encode=tfidf condition=objective

It reads, tells in one screen what it found, and writes a folder for ``popl-train data.load=`` and
``popl-people``.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from popl_rl.config import Checker, check_workers
from popl_rl.processes import count_workers, workers_for
from popl_rl.trainers.command import USER_ERRORS, read_options
from popl_rl.trainers.terminal import steady_terminal

__all__ = ["cli", "main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Import; returns the exit code."""
    parser = argparse.ArgumentParser("popl-import", description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path, help="file or folder to read")
    parser.add_argument("folder", type=Path, help="folder to write; '-' to look only")
    parser.add_argument(
        "option", nargs="*", help="name=value of the reader, or of encode=, workers="
    )
    parser.add_argument(
        "--reader", help="table, rankings, npz, chosen, folder or a reference; by itself"
    )
    given = parser.parse_intermixed_args(arguments)
    try:
        options = read_options(given.option)
        encode = options.pop("encode", None)
        cache = options.pop("cache", None)
        workers = options.pop("workers", "1") if encode else "1"
        problems: list[str] = []
        check_workers(workers, Checker("", problems))
        if problems:
            raise ValueError(problems[0])
        if str(given.folder) != "-" and given.folder.exists():
            raise FileExistsError(f"{given.folder} exists; remove it or choose another folder")
        _import(given.path, given.folder, given.reader, options, encode, cache, workers)
    except USER_ERRORS as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def _import(
    path: Path,
    folder: Path,
    reader: str | None,
    options: dict[str, Any],
    encode: str | None,
    cache: str | None,
    workers: str,
) -> None:
    # Imported late, so that a wrong option is told at once.
    from popl_rl.data.readers.opening import open_data
    from popl_rl.data.readers.summary import summarise
    from popl_rl.data.readers.writing import write_folder
    from popl_rl.experiments.progress import Progress

    with Progress("rows", total=None) as progress:
        data = open_data(path, reader=reader, options=options, progress=progress.update)
    if encode is not None:
        import torch

        from popl_rl.experiments.encoding import encoded

        kept = None if cache is None else Path(cache)
        # Together as many threads as this process has.
        threads = max(1, torch.get_num_threads() // count_workers(workers))
        with workers_for(workers, threads=threads) as processes:
            data = encoded(data, encode, cache=kept, workers=processes)
    for line in summarise(data).lines():
        print(line)
    if str(folder) == "-":
        return
    if not data.segments["observation"].shape[-1]:
        raise ValueError(
            "texts need features before anything is learnt from them: add encode=tfidf, or "
            "encode=<folder of a language model>, or features=<a .npy file>"
        )
    write_folder(data, folder)
    print(f"written to {folder}; train with popl-train data.load={folder}")


def cli() -> None:
    """Console command ``popl-import``."""
    with steady_terminal():
        sys.exit(main())


if __name__ == "__main__":
    cli()
