"""Who compares which pairs, and what they say: the answers of ``popl-label``."""

import random
import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from popl_rl.keys import Answer
from popl_rl.web.database import Database

__all__ = ["ATTENTION", "Given", "LabelQuestion", "LabelStore", "Rater"]

#: Number of the pair of a question that only checks whether somebody reads.
ATTENTION = -1
_ABANDONED = 1800.0  # seconds after which a question that nobody answered is free again

_SCHEMA = """
CREATE TABLE IF NOT EXISTS rater (
  id INTEGER PRIMARY KEY, token TEXT NOT NULL UNIQUE, name TEXT NOT NULL, code TEXT NOT NULL,
  began REAL NOT NULL);
CREATE TABLE IF NOT EXISTS question (
  rater INTEGER NOT NULL, position INTEGER NOT NULL, pair INTEGER NOT NULL,
  first INTEGER NOT NULL, second INTEGER NOT NULL, expected INTEGER, asked REAL NOT NULL,
  PRIMARY KEY (rater, position));
CREATE TABLE IF NOT EXISTS answer (
  id INTEGER PRIMARY KEY, rater INTEGER NOT NULL, position INTEGER NOT NULL,
  answer INTEGER NOT NULL, seconds REAL, at REAL NOT NULL, withdrawn INTEGER NOT NULL DEFAULT 0);
CREATE UNIQUE INDEX IF NOT EXISTS answer_once ON answer (rater, position) WHERE withdrawn = 0;
"""


@dataclass(frozen=True)
class Rater:
    """Somebody who compares.

    Attributes:
        id: Number, from 1.
        token: What the rater's cookie holds.
        name: As given; may be empty.
        code: To be shown at the end.
    """

    id: int
    token: str
    name: str
    code: str


@dataclass(frozen=True)
class LabelQuestion:
    """What a rater is asked.

    Attributes:
        position: Of the rater's questions, from 1.
        first: Segment on the left.
        second: Segment on the right.
        expected: Answer of an attention check; None for a pair.
    """

    position: int
    first: int
    second: int
    expected: int | None = None


@dataclass(frozen=True)
class Given:
    """An answer that counts.

    Attributes:
        rater: Number of the rater.
        first: Segment on the left.
        second: Segment on the right.
        answer: An ``popl_rl.keys.Answer``.
    """

    rater: int
    first: int
    second: int
    answer: int


class LabelStore:
    """Raters, their questions and their answers, one row each, in a file.

    Args:
        path: The file.
        pairs: Pairs of segments to compare.
        raters_per_pair: Raters for each; whoever comes gets the pair that has fewest.
        answers: Pairs of one rater at most.
        attention: Pairs between two attention checks; 0 for none.
        clock: Tells the time in seconds since 1970.

    Raises:
        ValueError: If the file holds something else.
    """

    def __init__(
        self,
        path: Path,
        pairs: Sequence[tuple[int, int]],
        *,
        raters_per_pair: int,
        answers: int,
        attention: int,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.database = Database(path, _SCHEMA, form="popl_rl.labels/1")
        self.pairs = list(pairs)
        self.raters_per_pair, self.answers, self.attention = raters_per_pair, answers, attention
        self.clock = clock
        # How often each pair was answered, and which questions are open, by rater and position: of
        # a file that this process alone writes to.
        self._answered = Counter(
            pair
            for (pair,) in self.database.all(
                "SELECT pair FROM answer JOIN question USING (rater, position) WHERE withdrawn = 0"
            )
        )
        self._open = {
            (rater, position): (pair, asked)
            for rater, position, pair, asked in self.database.all(
                "SELECT rater, position, pair, asked FROM question q WHERE NOT EXISTS "
                "(SELECT 1 FROM answer a WHERE a.rater = q.rater AND a.position = q.position AND "
                "withdrawn = 0)"
            )
        }

    def begin(self, name: str) -> Rater:
        """A new rater."""
        token, code = secrets.token_urlsafe(18), secrets.token_hex(4).upper()
        with self.database.writing():
            number = self.database.run(
                "INSERT INTO rater (token, name, code, began) VALUES (?, ?, ?, ?)",
                [token, name, code, self.clock()],
            )
        return Rater(number, token, name, code)

    def rater(self, token: str) -> Rater | None:
        """The rater with a token; None if there is none."""
        found = self.database.one(
            "SELECT id, token, name, code FROM rater WHERE token = ?", [token]
        )
        return None if found is None else Rater(*found)

    def answered(self, rater: Rater) -> int:
        """Number of pairs that a rater has answered, attention checks not counted."""
        found = self.database.one(
            "SELECT COUNT(*) FROM answer JOIN question USING (rater, position) "
            "WHERE rater = ? AND withdrawn = 0 AND pair >= 0",
            [rater.id],
        )
        assert found is not None
        return int(found[0])

    def is_check(self, rater: Rater, position: int) -> bool:
        """Whether a question of a rater is an attention check."""
        query = "SELECT pair FROM question WHERE rater = ? AND position = ?"
        return self.database.one(query, [rater.id, position]) == (ATTENTION,)

    def question(self, rater: Rater) -> LabelQuestion | None:
        """What a rater is to be asked now, the same until it is answered; None if nothing is left.

        Questions are answered in order, so that there is one that is open at most.
        """
        with self.database.writing():
            return self._find_open(rater) or self._ask(rater)

    def answer(
        self, rater: Rater, position: int, answer: int, seconds: float | None = None
    ) -> bool:
        """Keep an answer; on disk when this returns.

        Args:
            rater: Who answers.
            position: Which of the rater's questions.
            answer: An ``popl_rl.keys.Answer``.
            seconds: How long it took, as the page says.

        Returns:
            Whether it was kept: not if this question is answered already, which a second click is.

        Raises:
            KeyError: If the rater is not asked that.
            ValueError: If ``answer`` is none.
        """
        if answer not in tuple(Answer):
            raise ValueError(f"answer must be one of {[*map(int, Answer)]}, got {answer}")
        with self.database.writing():
            query = "SELECT pair FROM question WHERE rater = ? AND position = ?"
            asked = self.database.one(query, [rater.id, position])
            if asked is None:
                raise KeyError(f"rater {rater.id} has no question {position}")
            known = "SELECT 1 FROM answer WHERE rater = ? AND position = ? AND withdrawn = 0"
            if self.database.one(known, [rater.id, position]) is not None:
                return False
            self.database.run(
                "INSERT INTO answer (rater, position, answer, seconds, at) VALUES (?, ?, ?, ?, ?)",
                [rater.id, position, answer, seconds, self.clock()],
            )
        with self.database.lock:
            self._answered[asked[0]] += 1
            self._open.pop((rater.id, position), None)
        return True

    def undo(self, rater: Rater) -> bool:
        """Take the last answer back, so that its question is asked again; whether there was one.

        What was taken back is kept, and counts for nothing.
        """
        with self.database.writing():
            last = self.database.one(
                "SELECT position, pair FROM answer JOIN question USING (rater, position) WHERE "
                "rater = ? AND withdrawn = 0 ORDER BY position DESC LIMIT 1",
                [rater.id],
            )
            if last is None:
                return False
            self.database.run(
                "UPDATE answer SET withdrawn = 1 WHERE rater = ? AND position = ?",
                [rater.id, last[0]],
            )
        with self.database.lock:
            self._answered[last[1]] -= 1
            self._open[rater.id, last[0]] = last[1], self.clock()
        return True

    def given(self) -> list[Given]:
        """All answers about pairs that count, as they came."""
        rows = self.database.all(
            "SELECT rater, first, second, answer FROM answer JOIN question USING (rater, position) "
            "WHERE withdrawn = 0 AND pair >= 0 ORDER BY answer.id"
        )
        return [Given(*row) for row in rows]

    def attention_checks(self) -> dict[int, tuple[int, int]]:
        """Attention checks passed and answered, by rater."""
        rows = self.database.all(
            "SELECT rater, SUM(answer = expected), COUNT(*) FROM answer JOIN question USING "
            "(rater, position) WHERE withdrawn = 0 AND pair < 0 GROUP BY rater"
        )
        return {int(rater): (int(passed), int(total)) for rater, passed, total in rows}

    def _find_open(self, rater: Rater) -> LabelQuestion | None:
        """The first question of a rater that has no answer."""
        found = self.database.one(
            "SELECT position, first, second, expected FROM question q WHERE rater = ? AND "
            "NOT EXISTS (SELECT 1 FROM answer a WHERE a.rater = q.rater AND "
            "a.position = q.position AND withdrawn = 0) ORDER BY position LIMIT 1",
            [rater.id],
        )
        return None if found is None else LabelQuestion(*found)

    def _ask(self, rater: Rater) -> LabelQuestion | None:
        """The next question of a rater, chosen and kept."""
        database, now = self.database, self.clock()
        own = [
            pair
            for (pair,) in database.all(
                "SELECT pair FROM question WHERE rater = ? ORDER BY position", [rater.id]
            )
        ]
        position = len(own) + 1
        seen = set(own) - {ATTENTION}
        if len(seen) >= self.answers:
            return None
        draw = random.Random(f"{rater.token}/{position}")
        if self.attention and ATTENTION not in own[-self.attention :] and position > self.attention:
            first, second = self.pairs[draw.randrange(len(self.pairs))]
            pair, expected = ATTENTION, draw.randrange(2)
        else:
            waiting = Counter(
                pair for pair, asked in self._open.values() if asked > now - _ABANDONED
            )
            free = [
                (number, draw.random(), pair)
                for pair in range(len(self.pairs))
                if pair not in seen
                and (number := self._answered[pair] + waiting[pair]) < self.raters_per_pair
            ]
            if not free:
                return None
            pair, expected = min(free)[2], None
            first, second = self.pairs[pair]
            if draw.random() < 0.5:  # so that nobody's liking for a side tells anything
                first, second = second, first
        database.run(
            "INSERT INTO question VALUES (?, ?, ?, ?, ?, ?, ?)",
            [rater.id, position, pair, first, second, expected, now],
        )
        self._open[rater.id, position] = pair, now
        return LabelQuestion(position, first, second, expected)
