import pytest
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from popl_rl.web.guards import CSP, Guards, Rate, hosts_of


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


async def echo(request):
    return PlainTextResponse(await request.body())


def client(**changes):
    """A guarded page that says what it was sent."""
    settings = {
        "hosts": ("127.0.0.1", "localhost"),
        "key": None,
        "rate": Rate(100, 100),
        "newcomers": Rate(100, 100),
        "beginnings": ("/start",),
        **changes,
    }
    routes = [Route(path, echo, methods=["GET", "POST", "PUT"]) for path in ("/", "/start")]
    app = Starlette(routes=routes, middleware=[Middleware(Guards, **settings)])
    return TestClient(app, base_url="http://127.0.0.1:8000")


def test_answers_carry_strict_headers():
    response = client().get("/")
    assert response.headers["content-security-policy"] == CSP
    assert "unsafe" not in CSP
    assert response.headers["x-content-type-options"] == "nosniff"
    assert response.headers["cache-control"] == "no-store"


def test_a_body_comes_through_whole():
    body = "x" * 16_000
    assert client().post("/", content=body).text == body


def test_refusals():
    page = client()
    assert page.post("/", content="x" * 17_000).status_code == 413
    assert page.put("/").status_code == 405
    assert page.get("/", headers={"host": "evil.example"}).status_code == 421
    assert page.get("/", headers={"host": "localhost:8000"}).status_code == 200


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"origin": "http://127.0.0.1:8000"}, 200),
        ({"origin": "http://127.0.0.1:9000"}, 403),
        ({"origin": "https://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"sec-fetch-site": "same-origin"}, 200),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"sec-fetch-site": "same-site"}, 403),
    ],
)
def test_only_the_page_itself_may_post(headers, status):
    assert client().post("/", headers=headers).status_code == status


def test_a_key_is_asked_for_once():
    page = client(key="word", hosts=None)
    assert page.get("/").status_code == 403
    assert page.get("/?key=other").status_code == 403
    assert page.get("/?key=word").status_code == 200
    assert page.get("/").status_code == 200  # by the cookie
    assert client(key="word").get("/", headers={"cookie": "key=guess"}).status_code == 403


def test_visitors_take_their_turns():
    clock = Clock()
    page = client(rate=Rate(1, 3, clock))
    one, other = ({"cookie": f"visitor={name}"} for name in "ab")
    assert [page.get("/", headers=one).status_code for _ in range(4)] == [200, 200, 200, 429]
    assert page.get("/", headers=other).status_code == 200
    clock.now = 1.0
    assert [page.get("/", headers=one).status_code for _ in range(2)] == [200, 429]


def test_few_may_begin_at_once():
    page = client(newcomers=Rate(0, 2))
    assert [page.post("/start").status_code for _ in range(3)] == [200, 200, 429]
    assert page.post("/").status_code == 200


def test_names_by_which_a_server_is_known():
    assert hosts_of("127.0.0.1") == ("127.0.0.1", "localhost", "::1")
    assert hosts_of("lab.example") == ("lab.example",)
    assert hosts_of("0.0.0.0") is None
