"""The page on which a person finds a policy: ``popl-serve``.

====================  ==========================================================================
``GET /``             what is going to happen
``POST /start``       somebody new, told by a cookie from then on
``GET /find``         the next question, and the belief in each policy
``POST /answer``      keeps an answer: ``position``, ``answer``, ``seconds``
``POST /undo``        asks the last question again
``GET /policy``       the policy that was found, beside the one for everybody
``POST /verdict``     keeps whether it ``suits``: ``yes`` or ``no``
``GET /further``      random pairs, which tell whether it really does
``GET /researcher``   with ``?pass=``: who was served what; ``/researcher.csv`` and ``.json``
``/api/...``          the same for programs, see ``popl_rl.web.serve_api``
====================  ==========================================================================
"""

import csv
import hmac
import io
from collections.abc import Callable, Sequence
from dataclasses import asdict

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from popl_rl.web.catering import Agreement, Caterer, Found
from popl_rl.web.guards import VISITOR_COOKIE
from popl_rl.web.numbers import Number
from popl_rl.web.pages import Pages, answer_of, form, seconds_of, see
from popl_rl.web.person_store import Person
from popl_rl.web.serve_api import api_routes

__all__ = ["ServePages"]

_BARS = 8  # policies whose belief is drawn at most


class ServePages:
    """Pages of ``popl-serve``.

    Args:
        caterer: Finds policies.
        pages: Templates and clips.
        shows: Member -> numbers of the clips that show it; None -> of the one for everybody.
        numbers: What each policy does.
        word: Word that opens the researcher's page.
    """

    def __init__(
        self,
        caterer: Caterer,
        pages: Pages,
        *,
        shows: Callable[[int | None], Sequence[int]],
        numbers: Sequence[Number],
        word: str,
    ) -> None:
        self.caterer, self.pages, self.shows = caterer, pages, shows
        self.numbers, self.word = numbers, word
        self.store = caterer.store

    def app(self, *middleware: Middleware) -> Starlette:
        """The application."""
        own = [
            Route("/", self.begin),
            Route("/start", self.start, methods=["POST"]),
            Route("/find", self.find),
            Route("/answer", self.answer, methods=["POST"]),
            Route("/undo", self.undo, methods=["POST"]),
            Route("/policy", self.policy),
            Route("/verdict", self.verdict, methods=["POST"]),
            Route("/further", self.further),
            Route("/researcher", self.researcher),
            Route("/researcher.csv", self.as_csv),
            Route("/researcher.json", self.as_json),
        ]
        programs = api_routes(self.caterer, self.numbers, self.shows, self.pages.clips)
        return self.pages.application([*own, *programs], middleware)

    async def begin(self, request: Request) -> Response:
        """What is going to happen."""
        known = await self._person(request)
        return self.pages.show(
            request,
            "serve_begin",
            known=known is not None,
            questions=self.caterer.questions,
        )

    async def start(self, _request: Request) -> Response:
        """Somebody new."""
        person = await run_in_threadpool(self.store.begin)
        return see("/find", visitor=person.token)

    async def find(self, request: Request) -> Response:
        """The question that is open, or the policy."""
        person = await self._person(request)
        if person is None:
            return see("/")
        question = await run_in_threadpool(self.caterer.next_question, person)
        if question is None or question.further:
            return see("/policy")
        asked = await run_in_threadpool(self.store.asked, person)
        return self.pages.show(
            request,
            "serve_question",
            question=question,
            bars=self._bars(self.caterer.found(asked)),
            before=self._bars(self.caterer.found(asked[:-2])),
            questions=self.caterer.questions,
        )

    async def answer(self, request: Request) -> Response:
        """Keep an answer."""
        person = await self._known(request)
        said = await form(request)
        try:
            position = int(said.get("position", ""))
        except ValueError as error:
            raise HTTPException(400, "position must be a number") from error
        answer, seconds = answer_of(said.get("answer")), seconds_of(said.get("seconds"))
        try:
            await run_in_threadpool(self.store.answer, person, position, answer, seconds)
        except (KeyError, OverflowError) as error:
            raise HTTPException(409, "that is none of your questions") from error
        served = await run_in_threadpool(self.store.served, person)
        return see("/find" if served is None else "/further")

    async def undo(self, request: Request) -> Response:
        """Ask the last question again."""
        await run_in_threadpool(self.store.undo, await self._known(request))
        return see("/find")

    async def policy(self, request: Request) -> Response:
        """What was found."""
        person = await self._person(request)
        if person is None:
            return see("/")
        asked = await run_in_threadpool(self.store.asked, person)
        served = await run_in_threadpool(self.store.served, person)
        if served is None and not self.caterer.found(asked).is_over:
            return see("/find")
        found = await run_in_threadpool(self.caterer.serve, person)
        served = await run_in_threadpool(self.store.served, person)
        assert served is not None
        first = [one for one in asked if not one.further]
        return self.pages.show(
            request,
            "serve_policy",
            member=served.member,
            percent=round(100 * served.belief),
            suits=served.suits,
            bars=self._bars(found),
            answers=sum(one.answer is not None for one in first),
            agreed=self.caterer.agreement(asked, served.member, further=False),
            own=self.shows(served.member),
            everybody=self.shows(None),
            numbers=self.numbers,
            further=self.caterer.further,
        )

    async def verdict(self, request: Request) -> Response:
        """Keep whether it suits."""
        person = await self._known(request)
        said = (await form(request)).get("suits")
        if said not in ("yes", "no"):
            raise HTTPException(400, f"suits must be yes or no, got {said!r}")
        if not await run_in_threadpool(self.store.judge, person, suits=said == "yes"):
            raise HTTPException(409, "nothing was found for you yet")
        return see("/policy")

    async def further(self, request: Request) -> Response:
        """A random pair, to see whether the policy really suits."""
        person = await self._person(request)
        if person is None:
            return see("/")
        served = await run_in_threadpool(self.store.served, person)
        if served is None:
            return see("/find")
        question = await run_in_threadpool(self.caterer.further_question, person)
        asked = await run_in_threadpool(self.store.asked, person)
        agreed: Agreement = self.caterer.agreement(asked, served.member, further=True)
        return self.pages.show(
            request,
            "serve_further",
            question=question,
            number=sum(one.further for one in asked),
            total=self.caterer.further,
            agreed=agreed,
        )

    async def researcher(self, request: Request) -> Response:
        """Who was served what."""
        self._require_word(request)
        rows = await run_in_threadpool(self.caterer.rows)
        return self.pages.show(request, "researcher", rows=rows, word=self.word)

    async def as_csv(self, request: Request) -> Response:
        """The same as a file of comma-separated values."""
        self._require_word(request)
        rows = await run_in_threadpool(self.caterer.rows)
        file = io.StringIO()
        if rows:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        return Response(file.getvalue(), media_type="text/csv")

    async def as_json(self, request: Request) -> Response:
        """The same as JSON, with every question and answer."""
        self._require_word(request)
        rows = await run_in_threadpool(self.caterer.rows)
        people = await run_in_threadpool(self.store.people)
        for row, (person, _) in zip(rows, people, strict=False):
            asked = await run_in_threadpool(self.store.asked, person)
            row["asked"] = [asdict(one) for one in asked]
        return JSONResponse(rows)

    def _require_word(self, request: Request) -> None:
        given = request.query_params.get("pass", "")
        if not hmac.compare_digest(given.encode(), self.word.encode()):
            raise HTTPException(404, "there is no such page")

    def _bars(self, found: Found) -> list[tuple[int, float]]:
        """Members and the belief in each, those of the largest beliefs, in order of the members."""
        top = found.weights.topk(min(_BARS, len(found.weights))).indices.sort().values
        return [(member, float(found.weights[member])) for member in top.tolist()]

    async def _person(self, request: Request) -> Person | None:
        token = request.cookies.get(VISITOR_COOKIE, "")
        return await run_in_threadpool(self.store.person, token) if token else None

    async def _known(self, request: Request) -> Person:
        person = await self._person(request)
        if person is None:
            raise HTTPException(409, "begin on the first page")
        return person
