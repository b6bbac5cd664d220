"""One SQLite file that several threads of one server write to, and nothing confirmed is lost.

Write-ahead logging, and a synchronised commit before a page says that an answer is kept: it stays
through a killed process and a power cut.
"""

import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["Database"]


class Database:
    """A file with tables.

    Args:
        path: The file; made if it does not exist. Its folder exists.
        schema: Statements that make the tables unless they are there.
        form: What the file says of itself; another server's file is refused.

    Attributes:
        lock: Held by whoever reads or writes.

    Raises:
        ValueError: If the file is no database, or of another form.
    """

    def __init__(self, path: Path, schema: str, *, form: str) -> None:
        self.path = path
        self.lock = threading.RLock()
        # Transactions are ours (isolation_level=None), and the lock makes threads take turns.
        self._connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        try:
            self._connection.execute("PRAGMA journal_mode=WAL")
            self._connection.execute("PRAGMA synchronous=FULL")
            self._connection.executescript(schema)
            self._connection.execute(
                "CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL)"
            )
            with self.writing():
                self.run("INSERT OR IGNORE INTO about VALUES ('form', ?)", [form])
            found = self.one("SELECT value FROM about WHERE name = 'form'")
        except sqlite3.DatabaseError as error:
            raise ValueError(
                f"{path} is not readable as a database of answers ({error}); move it away"
            ) from error
        if found is None or found[0] != form:
            raise ValueError(
                f"{path} holds {None if found is None else found[0]!r}, expected {form!r}; choose "
                "another folder"
            )

    @contextmanager
    def writing(self) -> Iterator[None]:
        """A transaction: all of it is on disk when the block ends, or none of it."""
        with self.lock:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    def run(self, statement: str, values: Sequence[Any] = ()) -> int:
        """Run a statement inside of ``writing``; returns the number of the row it made."""
        with self.lock:
            return int(self._connection.execute(statement, values).lastrowid or 0)

    def all(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Rows of a query."""
        with self.lock:
            return self._connection.execute(query, values).fetchall()

    def one(self, query: str, values: Sequence[Any] = ()) -> tuple[Any, ...] | None:
        """First row of a query; None if there is none."""
        found = self.all(query, values)
        return found[0] if found else None

    def close(self) -> None:
        """Close the file."""
        with self.lock:
            self._connection.close()
