"""What both servers' pages are made of: templates, forms, cookies, files and clips."""

import html
import math
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs

import jinja2
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from popl_rl.web.clips import Clips
from popl_rl.web.guards import VISITOR_COOKIE
from popl_rl.web.translations import LANGUAGES, phrases

__all__ = ["Pages", "answer_of", "form", "markdown", "seconds_of", "see"]

_TYPES = {"css": "text/css", "js": "text/javascript"}
_YEAR = 31_536_000
_LONGEST = 3600.0  # seconds of thought that are believed
_ANSWERS = {"first": 0, "second": 1, "tie": 2, "skip": 3}


class Pages:
    """Templates in the visitor's language, and routes of what they need.

    Args:
        clips: Clips that pages show, by number.
        language: Until a visitor chooses another.
    """

    def __init__(self, clips: Clips, *, language: str) -> None:
        phrases(language)
        self.clips, self.language = clips, language
        self._templates = jinja2.Environment(
            loader=jinja2.PackageLoader("popl_rl.web"),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._templates.filters |= {"dictionary": dict, "number": _number}
        # Read at the start: no name in a request is ever a name of a file.
        folder = files("popl_rl.web") / "static"
        self._static = {
            file.name: file.read_bytes() for file in folder.iterdir() if "." in file.name
        }
        self._strips = {index: clip.strip for index, clip in clips.items() if clip.strip}

    def routes(self) -> list[Route]:
        """Routes of style sheet, scripts and clips, and of the choice of a language."""
        return [
            Route("/static/{name:str}", self._file),
            Route("/clip/{index:int}.webp", self._strip),
            Route("/language/{code:str}", self._choose_language, methods=["POST"]),
            Route("/favicon.ico", self._nothing),
        ]

    def application(self, routes: Sequence[Route], middleware: Sequence[Middleware]) -> Starlette:
        """An application of some routes, with those of all pages beside them."""
        return Starlette(
            routes=[*routes, *self.routes()],
            middleware=list(middleware),
            exception_handlers={HTTPException: self.problem, 500: self.problem},
        )

    def language_of(self, request: Request) -> str:
        """The language that a visitor chose, or the default."""
        chosen = request.cookies.get("language", "")
        return chosen if chosen in LANGUAGES else self.language

    def show(
        self, request: Request, template: str, *, status: int = 200, **values: Any
    ) -> Response:
        """A page in the visitor's language; values are escaped.

        Args:
            request: What is answered.
            template: Name of the file without its ending.
            status: HTTP status.
            values: What the template is told.
        """
        language = self.language_of(request)
        said = phrases(language)

        def t(name: str, /, **numbers: Any) -> str:
            return said[name].format(**numbers)

        page = self._templates.get_template(f"{template}.html").render(
            t=t, language=language, languages=LANGUAGES, clips=self.clips, **values
        )
        return HTMLResponse(page, status)

    async def problem(self, request: Request, error: Exception) -> Response:
        """A page that says what is wrong, for ``exception_handlers`` of an application."""
        status = error.status_code if isinstance(error, HTTPException) else 500
        if request.url.path.startswith("/api/"):
            from starlette.responses import JSONResponse

            detail = error.detail if isinstance(error, HTTPException) else "a defect of the server"
            return JSONResponse({"error": detail}, status)
        known = {400: "error_request", 404: "error_missing", 409: "error_question"}
        return self.show(request, "problem", status=status, what=known.get(status, "error_server"))

    async def _file(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in self._static:
            raise HTTPException(404, "there is no such file")
        kind = _TYPES[name.rpartition(".")[2]]
        return Response(self._static[name], media_type=kind)

    async def _strip(self, request: Request) -> Response:
        strip = self._strips.get(request.path_params["index"])
        if strip is None:
            raise HTTPException(404, "there is no such clip")
        # Rendered once and never again; and seen by people who were let in alone.
        headers = {"cache-control": f"private, max-age={_YEAR}, immutable"}
        return Response(strip, media_type="image/webp", headers=headers)

    async def _nothing(self, _request: Request) -> Response:
        """No picture for the tab; browsers ask all the same."""
        return Response(status_code=204)

    async def _choose_language(self, request: Request) -> Response:
        code = request.path_params["code"]
        if code not in LANGUAGES:
            raise HTTPException(404, "there is no such language")
        back = see((await form(request)).get("back", "/"))
        back.set_cookie("language", code, max_age=_YEAR, httponly=True, samesite="strict")
        return back


def _number(value: Any) -> str:
    """Two digits behind the point, or a dash for what there is not."""
    number = float(value)
    return f"{number:.2f}".replace("-", "\N{MINUS SIGN}") if math.isfinite(number) else "–"


def see(path: str, *, visitor: str | None = None) -> Response:
    """Send a visitor on to a page of ours, perhaps with a cookie that says who it is."""
    own = re.fullmatch(r"/[a-z]*", path)
    response = RedirectResponse(path if own else "/", 303)
    if visitor is not None:
        response.set_cookie(
            VISITOR_COOKIE, visitor, max_age=_YEAR, httponly=True, samesite="strict"
        )
    return response


async def form(request: Request) -> Mapping[str, str]:
    """Fields of a form that was sent as ``application/x-www-form-urlencoded``; none of no body.

    Raises:
        HTTPException: With 400, if it was not, or cannot be read.
    """
    body = await request.body()
    if not body:
        return {}
    kind = request.headers.get("content-type", "").partition(";")[0].strip()
    if kind != "application/x-www-form-urlencoded":
        raise HTTPException(400, "expected a form")
    try:
        fields = parse_qs(body.decode(), keep_blank_values=True, max_num_fields=20)
    except ValueError as error:
        raise HTTPException(400, f"a form that cannot be read: {error}") from error
    return {name: values[-1] for name, values in fields.items()}


def answer_of(value: object) -> int:
    """The ``popl_rl.keys.Answer`` that is called ``first``, ``second``, ``tie`` or ``skip``.

    Raises:
        HTTPException: With 400, if it is something else.
    """
    if not isinstance(value, str) or value not in _ANSWERS:
        raise HTTPException(400, f"answer must be one of {', '.join(_ANSWERS)}, got {value!r}")
    return _ANSWERS[value]


def seconds_of(value: object) -> float | None:
    """Seconds that an answer took, as a page says; None if it says nothing that can be true."""
    try:
        seconds = float(str(value))
    except ValueError:
        return None
    return seconds if 0 <= seconds <= _LONGEST else None


def markdown(text: str) -> Markup:
    """The little Markdown that instructions need: headings, lists, paragraphs, bold and italics.

    Everything else, HTML too, is shown as it is written.
    """
    blocks = []
    for block in re.split(r"\n\s*\n", text.strip()):
        lines = [_inline(line.strip()) for line in block.splitlines()]
        if heading := re.match(r"(#{1,3}) ", block):
            level = len(heading[1]) + 1  # the page has a heading of its own
            blocks.append(f"<h{level}>{lines[0].lstrip('# ')}</h{level}>")
            lines = lines[1:]
            if not lines:
                continue
        if all(line.startswith(("- ", "* ")) for line in lines):
            blocks.append("<ul>" + "".join(f"<li>{line[2:]}</li>" for line in lines) + "</ul>")
        else:
            blocks.append(f"<p>{' '.join(lines)}</p>")
    return Markup("\n".join(blocks))


def _inline(line: str) -> str:
    escaped = html.escape(line)
    bold = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", escaped)
    return re.sub(r"\*(?! )(.+?)\*", r"<em>\1</em>", bold)
