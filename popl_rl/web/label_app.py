"""The page on which people compare clips: ``popl-label``.

====================  ==========================================================================
``GET /``             instructions, and a name or none
``POST /start``       a new rater, told by a cookie from then on
``GET /label``        two clips, and what one can say of them
``POST /answer``      keeps an answer: ``position``, ``answer``, ``seconds``
``POST /undo``        takes the last answer back
``GET /pause``        now and then, for as long as somebody likes
``GET /done``         thanks, and a completion code
``GET /back``         with ``?rater=``: the link by which a rater goes on elsewhere
====================  ==========================================================================
"""

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from popl_rl.web.guards import VISITOR_COOKIE
from popl_rl.web.label_store import LabelStore, Rater
from popl_rl.web.pages import Pages, answer_of, form, markdown, seconds_of, see

__all__ = ["LabelPages"]

_LONGEST_NAME = 60


class LabelPages:
    """Pages of ``popl-label``.

    Args:
        store: Raters and answers.
        pages: Templates and clips.
        instructions: Markdown in the place of the library's own text; None for that.
        pause: Answers after which a pause is offered; 0 for never.
    """

    def __init__(
        self, store: LabelStore, pages: Pages, *, instructions: str | None = None, pause: int = 0
    ) -> None:
        self.store, self.pages, self.pause = store, pages, pause
        self.instructions = None if instructions is None else markdown(instructions)

    def app(self, *middleware: Middleware) -> Starlette:
        """The application."""
        own = [
            Route("/", self.begin),
            Route("/start", self.start, methods=["POST"]),
            Route("/label", self.label),
            Route("/answer", self.answer, methods=["POST"]),
            Route("/undo", self.undo, methods=["POST"]),
            Route("/pause", self.rest),
            Route("/done", self.done),
            Route("/back", self.back),
        ]
        return self.pages.application(own, middleware)

    def begin(self, request: Request) -> Response:
        """Instructions."""
        return self.pages.show(
            request,
            "label_begin",
            instructions=self.instructions,
            known=self._rater(request) is not None,
        )

    async def start(self, request: Request) -> Response:
        """A new rater."""
        name = (await form(request)).get("name", "").strip()[:_LONGEST_NAME]
        rater = await run_in_threadpool(self.store.begin, name)
        return see("/label", visitor=rater.token)

    def label(self, request: Request) -> Response:
        """The question that is open."""
        rater = self._rater(request)
        if rater is None:
            return see("/")
        question = self.store.question(rater)
        if question is None:
            return see("/done")
        total = min(self.store.answers, len(self.store.pairs))
        done = self.store.answered(rater)
        return self.pages.show(
            request, "label", question=question, done=done, total=total, rater=rater
        )

    async def answer(self, request: Request) -> Response:
        """Keep an answer."""
        said = await form(request)
        try:
            position = int(said.get("position", ""))
        except ValueError as error:
            raise HTTPException(400, "position must be a number") from error
        answer, seconds = answer_of(said.get("answer")), seconds_of(said.get("seconds"))
        return await run_in_threadpool(self._keep, request, position, answer, seconds)

    def _keep(
        self, request: Request, position: int, answer: int, seconds: float | None
    ) -> Response:
        rater = self._known(request)
        try:
            kept = self.store.answer(rater, position, answer, seconds)
        except (KeyError, OverflowError) as error:
            raise HTTPException(409, "that is none of your questions") from error
        if kept and self.pause and not self.store.is_check(rater, position):
            done = self.store.answered(rater)
            if done % self.pause == 0 and done < self.store.answers:
                return see("/pause")
        return see("/label")

    async def undo(self, request: Request) -> Response:
        """Take the last answer back."""
        await run_in_threadpool(lambda: self.store.undo(self._known(request)))
        return see("/label")

    def rest(self, request: Request) -> Response:
        """A pause."""
        rater = self._rater(request)
        if rater is None:
            return see("/")
        done = self.store.answered(rater)
        return self.pages.show(request, "label_pause", done=done, rater=rater)

    def done(self, request: Request) -> Response:
        """Thanks."""
        rater = self._rater(request)
        if rater is None:
            return see("/")
        if self.store.question(rater) is not None:
            return see("/label")
        done = self.store.answered(rater)
        return self.pages.show(request, "label_done", rater=rater, done=done)

    def back(self, request: Request) -> Response:
        """Go on as an earlier rater."""
        rater = self.store.rater(request.query_params.get("rater", ""))
        if rater is None:
            raise HTTPException(404, "there is no such rater")
        return see("/label", visitor=rater.token)

    def _rater(self, request: Request) -> Rater | None:
        token = request.cookies.get(VISITOR_COOKIE, "")
        return self.store.rater(token) if token else None

    def _known(self, request: Request) -> Rater:
        rater = self._rater(request)
        if rater is None:
            raise HTTPException(409, "begin on the first page")
        return rater
