"""The JSON interface of ``popl-serve``: the same questions and policies, for programs.

``POST /api/start`` answers ``{"token": "..."}``; every other request carries
``Authorization: Bearer <token>``.

``GET /api/next``
    ``{"question": {"position": 1, "pair": [12, 7], "clips": [{...}, {...}]}, "belief": [0.5, 0.5],
    "over": false}``; ``question`` is null once ``over``. A clip is ``{"strip": "/clip/12.webp",
    "frames": 13, "rate": 10, "text": ""}``: frames side by side, or a text and no strip.
``POST /api/answer``
    takes ``{"position": 1, "answer": "first", "seconds": 2.5}``, answer out of ``first second tie
    skip``; answers as ``/api/next`` does, which then has the next question.
``GET /api/policy``
    ``{"member": 1, "belief": 0.97, "agrees": 4, "strict": 5, "clips": [...], "everybody":
    [...], "numbers": [{"name": "m_success", "about": {}, "own": 0.98, "everybody": 0.4}]}``;
    409 before enough is known.

What goes wrong is ``{"error": "..."}``: 400 for what cannot be read, 401 without a token that is
known, 409 for a question that is none of this person's, 413, 421, 429 as for pages.
"""

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from popl_rl.web.catering import Caterer
from popl_rl.web.clips import Clips
from popl_rl.web.numbers import Number
from popl_rl.web.pages import answer_of, seconds_of
from popl_rl.web.person_store import Person

__all__ = ["api_routes"]


def api_routes(
    caterer: Caterer,
    numbers: Sequence[Number],
    shows: Callable[[int | None], Sequence[int]],
    clips: Clips,
) -> list[Route]:
    """Routes of the interface.

    Args:
        caterer: Finds policies.
        numbers: What each policy does.
        shows: Member -> numbers of the clips that show it.
        clips: Clips by number.
    """
    api = _Interface(caterer, numbers, shows, clips)
    return [
        Route("/api/start", api.start, methods=["POST"]),
        Route("/api/next", api.next),
        Route("/api/answer", api.answer, methods=["POST"]),
        Route("/api/policy", api.policy),
    ]


class _Interface:
    def __init__(
        self,
        caterer: Caterer,
        numbers: Sequence[Number],
        shows: Callable[[int | None], Sequence[int]],
        clips: Clips,
    ) -> None:
        self.caterer, self.numbers, self.shows, self.clips = caterer, numbers, shows, clips

    async def start(self, _request: Request) -> Response:
        person = await run_in_threadpool(self.caterer.store.begin)
        return JSONResponse({"token": person.token}, 201)

    async def next(self, request: Request) -> Response:
        return await self._next(await self._person(request))

    async def answer(self, request: Request) -> Response:
        person = await self._person(request)
        try:
            said = json.loads(await request.body())
        except ValueError as error:
            raise HTTPException(400, f"expected JSON: {error}") from error
        position = said.get("position") if isinstance(said, dict) else None
        if not isinstance(position, int) or isinstance(position, bool):
            raise HTTPException(400, f"position must be a number, got {position!r}")
        answer, seconds = answer_of(said.get("answer")), seconds_of(said.get("seconds"))
        store = self.caterer.store
        try:
            await run_in_threadpool(store.answer, person, position, answer, seconds)
        except (KeyError, OverflowError) as error:
            raise HTTPException(409, "that is none of your questions") from error
        return await self._next(person)

    async def policy(self, request: Request) -> Response:
        person = await self._person(request)
        caterer = self.caterer
        asked = await run_in_threadpool(caterer.store.asked, person)
        if not caterer.found(asked).is_over:
            raise HTTPException(409, "not enough is known yet; ask /api/next")
        await run_in_threadpool(caterer.serve, person)
        served = await run_in_threadpool(caterer.store.served, person)
        assert served is not None
        agreed = caterer.agreement(asked, served.member, further=False)
        return JSONResponse(
            {
                "member": served.member,
                "belief": served.belief,
                "agrees": agreed.own,
                "strict": agreed.strict,
                "clips": self._clips(self.shows(served.member)),
                "everybody": self._clips(self.shows(None)),
                "numbers": [
                    {
                        "name": number.phrase,
                        "about": dict(number.about),
                        "own": _finite(number.values[served.member]),
                        "everybody": _finite(number.everybody),
                    }
                    for number in self.numbers
                ],
            }
        )

    async def _next(self, person: Person) -> Response:
        question = await run_in_threadpool(self.caterer.next_question, person)
        found = self.caterer.found(await run_in_threadpool(self.caterer.store.asked, person))
        shown: dict[str, Any] | None = None
        if question is not None and not question.further:
            pair = [question.first, question.second]
            shown = {"position": question.position, "pair": pair}
            shown["clips"] = self._clips(pair)
        return JSONResponse(
            {"question": shown, "belief": found.weights.tolist(), "over": shown is None}
        )

    def _clips(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        shown = []
        for index in indices:
            clip = self.clips[index]
            shown.append({"strip": f"/clip/{index}.webp" if clip.strip else None, **clip.about()})
        return shown

    async def _person(self, request: Request) -> Person:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        known = kind.lower() == "bearer" and token
        person = await run_in_threadpool(self.caterer.store.person, token) if known else None
        if person is None:
            raise HTTPException(401, "send Authorization: Bearer <token> of /api/start")
        return person


def _finite(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None
