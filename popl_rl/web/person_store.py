"""Who looks for a policy, what they answered and what they were served: kept by ``popl-serve``."""

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from popl_rl.keys import Answer
from popl_rl.web.database import Database

__all__ = ["Asked", "Person", "PersonStore", "Served"]

_SCHEMA = """
CREATE TABLE IF NOT EXISTS person (
  id INTEGER PRIMARY KEY, token TEXT NOT NULL UNIQUE, began REAL NOT NULL);
CREATE TABLE IF NOT EXISTS question (
  person INTEGER NOT NULL, position INTEGER NOT NULL, first INTEGER NOT NULL,
  second INTEGER NOT NULL, further INTEGER NOT NULL, asked REAL NOT NULL,
  answer INTEGER, seconds REAL, at REAL, PRIMARY KEY (person, position));
CREATE TABLE IF NOT EXISTS served (
  person INTEGER PRIMARY KEY, member INTEGER NOT NULL, belief REAL NOT NULL, at REAL NOT NULL,
  suits INTEGER);
"""


@dataclass(frozen=True)
class Person:
    """Somebody who looks for a policy: a number from 1, and what the cookie holds."""

    id: int
    token: str


@dataclass(frozen=True)
class Asked:
    """A question that a person was asked.

    Attributes:
        position: Of the person's questions, from 1.
        first: Segment on the left.
        second: Segment on the right.
        further: Whether it was asked after a policy had been served.
        answer: An ``popl_rl.keys.Answer``; None if it is open.
    """

    position: int
    first: int
    second: int
    further: bool
    answer: int | None = None


@dataclass(frozen=True)
class Served:
    """What a person was served.

    Attributes:
        member: The policy.
        belief: Belief in it then.
        suits: Whether it suits, as the person says; None if nothing was said.
    """

    member: int
    belief: float
    suits: bool | None = None


class PersonStore:
    """People, their answers and what they were served, in a file.

    Args:
        path: The file.
        clock: Tells the time in seconds since 1970.

    Raises:
        ValueError: If the file holds something else.
    """

    def __init__(self, path: Path, *, clock: Callable[[], float] = time.time) -> None:
        self.database = Database(path, _SCHEMA, form="popl_rl.served/1")
        self.clock = clock

    def begin(self) -> Person:
        """Somebody new."""
        token = secrets.token_urlsafe(18)
        with self.database.writing():
            number = self.database.run(
                "INSERT INTO person (token, began) VALUES (?, ?)", [token, self.clock()]
            )
        return Person(number, token)

    def person(self, token: str) -> Person | None:
        """The person with a token; None if there is none."""
        found = self.database.one("SELECT id, token FROM person WHERE token = ?", [token])
        return None if found is None else Person(*found)

    def people(self) -> list[tuple[Person, float]]:
        """Everybody, and when each began, in order."""
        rows = self.database.all("SELECT id, token, began FROM person ORDER BY id")
        return [(Person(number, token), began) for number, token, began in rows]

    def asked(self, person: Person) -> list[Asked]:
        """Everything that a person was asked, in order."""
        rows = self.database.all(
            "SELECT position, first, second, further, answer FROM question WHERE person = ? "
            "ORDER BY position",
            [person.id],
        )
        return [
            Asked(position, first, second, bool(further), answer)
            for position, first, second, further, answer in rows
        ]

    def ask(self, person: Person, pair: tuple[int, int], *, further: bool) -> Asked:
        """Keep what a person is asked next, unless something is open already; what is open."""
        with self.database.writing():
            asked = self.asked(person)
            if asked and asked[-1].answer is None:
                return asked[-1]
            self.database.run(
                "INSERT INTO question (person, position, first, second, further, asked) "
                "VALUES (?, ?, ?, ?, ?, ?)",
                [person.id, len(asked) + 1, *pair, further, self.clock()],
            )
        return Asked(len(asked) + 1, *pair, further)

    def answer(
        self, person: Person, position: int, answer: int, seconds: float | None = None
    ) -> bool:
        """Keep an answer; on disk when this returns.

        Returns:
            Whether it was kept: not if this question is answered already.

        Raises:
            KeyError: If the person is not asked that.
            ValueError: If ``answer`` is none.
        """
        if answer not in tuple(Answer):
            raise ValueError(f"answer must be one of {[*map(int, Answer)]}, got {answer}")
        with self.database.writing():
            found = self.database.one(
                "SELECT answer FROM question WHERE person = ? AND position = ?",
                [person.id, position],
            )
            if found is None:
                raise KeyError(f"person {person.id} has no question {position}")
            if found[0] is not None:
                return False
            self.database.run(
                "UPDATE question SET answer = ?, seconds = ?, at = ? WHERE person = ? AND "
                "position = ?",
                [answer, seconds, self.clock(), person.id, position],
            )
        return True

    def undo(self, person: Person) -> bool:
        """Ask the last question again, before a policy was served; whether there was one."""
        with self.database.writing():
            if self.served(person) is not None:
                return False
            asked = self.asked(person)
            answered = [one for one in asked if one.answer is not None]
            if not answered:
                return False
            last = answered[-1].position
            # What was asked in the light of that answer is asked anew.
            self.database.run(
                "DELETE FROM question WHERE person = ? AND position > ?", [person.id, last]
            )
            self.database.run(
                "UPDATE question SET answer = NULL, seconds = NULL, at = NULL WHERE person = ? AND "
                "position = ?",
                [person.id, last],
            )
        return True

    def serve(self, person: Person, member: int, belief: float) -> Served:
        """Keep what a person is served, the first time; what it was."""
        with self.database.writing():
            self.database.run(
                "INSERT OR IGNORE INTO served (person, member, belief, at) VALUES (?, ?, ?, ?)",
                [person.id, member, belief, self.clock()],
            )
            served = self.served(person)
        assert served is not None
        return served

    def served(self, person: Person) -> Served | None:
        """What a person was served; None if nothing yet."""
        found = self.database.one(
            "SELECT member, belief, suits FROM served WHERE person = ?", [person.id]
        )
        if found is None:
            return None
        return Served(found[0], found[1], None if found[2] is None else bool(found[2]))

    def judge(self, person: Person, *, suits: bool) -> bool:
        """Keep whether what was served suits; whether anything was."""
        with self.database.writing():
            self.database.run("UPDATE served SET suits = ? WHERE person = ?", [suits, person.id])
            return self.served(person) is not None
