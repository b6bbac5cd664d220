import re
from string import Formatter

import pytest
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.testclient import TestClient

from popl_rl.web.clips import Clip
from popl_rl.web.pages import Pages, answer_of, markdown, seconds_of, see
from popl_rl.web.translations import LANGUAGES, phrases


def holes(text):
    return {name for _, name, _, _ in Formatter().parse(text) if name}


def test_languages_say_the_same():
    english = phrases("en")
    for language in LANGUAGES:
        other = phrases(language)
        assert other.keys() == english.keys()
        assert {name: holes(text) for name, text in other.items()} == {
            name: holes(text) for name, text in english.items()
        }
    assert phrases("de") != english
    with pytest.raises(ValueError, match="language must be one of en, de, got 'xx'"):
        phrases("xx")


def test_markdown_is_little_and_safe():
    text = "# Wei<b>\n\nSay *which* is **better**.\n<script>alert(1)</script>\n\n- one\n- two & 3"
    assert markdown(text) == (
        "<h2>Wei&lt;b&gt;</h2>\n"
        "<p>Say <em>which</em> is <strong>better</strong>. "
        "&lt;script&gt;alert(1)&lt;/script&gt;</p>\n"
        "<ul><li>one</li><li>two &amp; 3</li></ul>"
    )


@pytest.mark.parametrize(
    "path", ["//evil.example", "https://evil.example", "/a/../b", "\\\\x", "/a\r\nb", "/a\n"]
)
def test_visitors_are_sent_to_our_own_pages_alone(path):
    assert see(path).headers["location"] == "/"
    assert see("/label").headers["location"] == "/label"


def test_cookies_are_out_of_reach_of_scripts_and_other_sites():
    cookie = see("/label", visitor="token").headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()


def test_what_a_form_may_say():
    assert [answer_of(name) for name in ("first", "second", "tie", "skip")] == [0, 1, 2, 3]
    for wrong in ("third", "0", None, 1, ["first"]):
        with pytest.raises(HTTPException, match="answer must be one of first, second, tie, skip"):
            answer_of(wrong)
    assert seconds_of("2.5") == 2.5
    for wrong in ("", "-1", "nan", "inf", "1e9", None, "x"):
        assert seconds_of(wrong) is None


@pytest.fixture
def client():
    pages = Pages({7: Clip(2, 10.0, b"strip"), 8: Clip(text="words")}, language="en")
    handlers = {HTTPException: pages.problem}
    return TestClient(Starlette(routes=pages.routes(), exception_handlers=handlers))


def test_files_and_clips(client):
    assert client.get("/clip/7.webp").content == b"strip"
    assert client.get("/clip/7.webp").headers["content-type"] == "image/webp"
    assert "immutable" in client.get("/clip/7.webp").headers["cache-control"]
    for name in ("style.css", "clips.js", "answers.js", "belief.js"):
        assert client.get(f"/static/{name}").status_code == 200
    assert client.get("/favicon.ico").status_code == 204


@pytest.mark.parametrize(
    "path",
    [
        "/clip/8.webp",
        "/clip/9.webp",
        "/clip/-1.webp",
        "/clip/99999999999999999999999.webp",
        "/static/nothing.css",
        "/static/..%2Fpages.py",
        "/static/../pages.py",
        "/static/%2Fetc%2Fpasswd",
        "/language/xx",
    ],
)
def test_no_path_leads_to_other_files(client, path):
    assert client.get(path).status_code in (404, 405)


def test_a_chosen_language_stays(client):
    chosen = client.post("/language/de", data={"back": "/x"}, follow_redirects=False)
    assert chosen.headers["location"] == "/x"
    missing = client.get("/clip/1.webp")
    assert re.search('<html lang="de">', missing.text)
    assert phrases("de")["error_missing"] in missing.text
    assert client.post("/language/xx", data={}).status_code == 404
    assert client.post("/language/en", json={}).status_code == 400
