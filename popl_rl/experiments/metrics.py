"""`metrics.csv` and `history.csv`: a row for each generation, safe against kills."""

import csv
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from popl_rl.storage import explaining_full_disk, write_atomic

__all__ = ["MetricsWriter", "write_sizes"]


class MetricsWriter:
    """``metrics.csv``: a row for each generation, safe against kills.

    The first row fixes the columns. Floats are written so that they read back exactly.

    Args:
        path: The file; rows are added to one that exists, after dropping a torn last line.

    Attributes:
        path: The file.

    Raises:
        ValueError: If ``path`` exists and is not such a file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._columns: list[str] = []
        if path.exists():
            self._keep(lambda _: True)

    def write(self, generation: int, metrics: Mapping[str, float]) -> None:
        """Add the row of a generation.

        Args:
            generation: Generations done.
            metrics: Scalars; a column that is missing here stays empty.

        Raises:
            ValueError: If a metric is new after the first row.
        """
        row = {"generation": generation, **metrics}
        first = not self._columns
        columns = self._columns or list(row)
        unknown = [name for name in row if name not in columns]
        if unknown:
            raise ValueError(
                f"metrics must keep the columns of the first row of {self.path}, {columns}, got "
                f"the new {unknown}; report them from the first generation on, as nan if unknown"
            )
        line = io.StringIO()
        writer = csv.DictWriter(line, columns, restval="", lineterminator="\n")
        if first:
            writer.writeheader()
        writer.writerow(row)
        if first:
            write_atomic(self.path, line.getvalue())
            self._columns = columns
        else:
            with explaining_full_disk(self.path), self.path.open("a", encoding="utf-8") as file:
                file.write(line.getvalue())
                file.flush()
                os.fsync(file.fileno())

    def truncate_to(self, generation: int) -> None:
        """Drop the rows of later generations, which a resumed run will write again.

        Args:
            generation: Last generation to keep; 0 to start over.
        """
        if self.path.exists():
            self._keep(lambda row: row <= generation)

    def _keep(self, wanted: Callable[[int], bool]) -> None:
        text = self.path.read_text(encoding="utf-8")
        lines = [line for line in text.splitlines(keepends=True) if line.endswith("\n")]
        columns = next(csv.reader(lines[:1]), [])
        try:
            if columns[:1] != ["generation"]:
                raise ValueError(f"its columns are {columns}")
            rows = [line for line in lines[1:] if wanted(int(line.split(",")[0]))]
        except ValueError as error:
            raise ValueError(
                f"{self.path} must be a table whose first column is the generation, but {error}; "
                "move it away"
            ) from error
        kept = "".join([lines[0], *rows]) if rows else ""
        self._columns = columns if rows else []
        if not kept:
            self.path.unlink()
        elif kept != text:
            write_atomic(self.path, kept)


def write_sizes(method: Any, path: Path) -> None:
    """How well sets of each size predict raters, by methods that count their members so."""
    sizes = getattr(method, "sizes", None)
    if sizes:
        rows = [f"{size},{mean:.6f},{error:.6f}\n" for size, mean, error in sizes]
        write_atomic(path, "".join(["members,log_likelihood,error\n", *rows]))
