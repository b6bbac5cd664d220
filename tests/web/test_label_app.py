import re

import pytest
from starlette.testclient import TestClient

from popl_rl.web.clips import Clip
from popl_rl.web.guards import guards
from popl_rl.web.label_app import LabelPages
from popl_rl.web.label_store import LabelStore
from popl_rl.web.pages import Pages

PAIRS = [(0, 1), (2, 3), (4, 5)]
CLIPS = {index: Clip(3, 10.0, b"strip") for index in range(4)} | {
    4: Clip(text="<b>four</b>"),
    5: Clip(text="five"),
}


@pytest.fixture
def store(tmp_path):
    store = LabelStore(
        tmp_path / "answers.sqlite", PAIRS, raters_per_pair=2, answers=3, attention=2
    )
    yield store
    store.database.close()


@pytest.fixture
def visitor(store):
    """Makes a new browser, as it were."""
    pages = LabelPages(store, Pages(CLIPS, language="en"), instructions="Be *kind*.", pause=2)
    guard = guards(hosts=("testserver",), key=None, rate=100, newcomers=100)
    app = pages.app(guard)
    return lambda: TestClient(app)


def asked(page):
    [position] = re.findall(r'name="position" value="(\d+)"', page.text)
    return int(position)


def answer(browser, position, value="first", **more):
    fields = {"position": position, "answer": value, "seconds": "1.25", **more}
    return browser.post("/answer", data=fields)


def test_from_the_first_page_to_the_code(visitor, store):
    browser = visitor()
    assert "Be <em>kind</em>." in browser.get("/").text
    page = browser.post("/start", data={"name": "  Ann <i> "})
    assert page.url.path == "/label"
    seen = []
    while page.url.path in ("/label", "/pause"):
        seen.append(page.url.path)
        if page.url.path == "/pause":
            assert "You have given 2 answers" in page.text
            page = browser.get("/label")
            continue
        is_check = "please choose" in page.text
        value = "second" if "choose right" in page.text else "first"
        seen[-1] = "check" if is_check else "pair"
        page = answer(browser, asked(page), value)
    assert seen == ["pair", "pair", "/pause", "check", "pair"]
    assert page.url.path == "/done"
    rater = store.rater(browser.cookies["visitor"])
    assert rater.code in page.text
    assert rater.name == "Ann <i>"
    assert len(store.given()) == 3
    assert store.attention_checks() == {rater.id: (1, 1)}
    assert store.database.all("SELECT DISTINCT seconds FROM answer") == [(1.25,)]


def test_undo_reload_and_coming_back(visitor, store):
    browser = visitor()
    page = browser.post("/start", data={})
    first = page.text
    assert browser.get("/label").text == first  # a reload changes nothing
    answer(browser, 1, "second")
    assert browser.post("/undo").text == first
    answer(browser, 1, "tie")
    assert [given.answer for given in store.given()] == [2]
    # Another browser goes on by the link.
    other = visitor()
    token = browser.cookies["visitor"]
    assert other.get(f"/back?rater={token}").text == browser.get("/label").text
    assert other.get("/back?rater=guess").status_code == 404
    assert 'href="/label">Go on' in browser.get("/").text


def test_a_second_click_counts_once(visitor, store):
    browser = visitor()
    browser.post("/start", data={})
    assert answer(browser, 1).url.path == "/label"
    assert answer(browser, 1, "second").url.path == "/label"
    assert [given.answer for given in store.given()] == [0]


@pytest.mark.parametrize(
    ("fields", "status"),
    [
        ({"position": "2"}, 409),
        ({"position": "-1"}, 409),
        ({"position": "9" * 40}, 409),
        ({"position": "x"}, 400),
        ({"position": ""}, 400),
        ({"position": "1", "answer": "third"}, 400),
    ],
)
def test_what_was_not_asked_is_refused(visitor, store, fields, status):
    browser = visitor()
    browser.post("/start", data={})
    response = browser.post("/answer", data={"answer": "first", **fields})
    assert response.status_code == status
    assert "That did not work" in browser.post("/answer", data={"answer": "x"}).text
    assert store.given() == []


def test_strangers_are_sent_to_the_first_page(visitor):
    browser = visitor()
    for path in ("/label", "/pause", "/done"):
        assert browser.get(path).url.path == "/"
    for path in ("/answer", "/undo"):
        said = {"position": 1, "answer": "first"}
        assert browser.post(path, data=said).status_code == 409
    assert visitor().post("/start", headers={"origin": "http://evil"}).status_code == 403


def test_nobody_is_done_before_the_end(visitor):
    browser = visitor()
    browser.post("/start", data={})
    assert browser.get("/done").url.path == "/label"


def test_texts_are_shown_as_text_and_strips_as_strips(visitor, store):
    browser = visitor()
    page = browser.post("/start", data={})
    pages = [page.text]
    while page.url.path != "/done":
        page = answer(browser, asked(page)) if page.url.path == "/label" else browser.get("/label")
        pages.append(page.text)
    everything = "".join(pages)
    assert "&lt;b&gt;four&lt;/b&gt;" in everything
    assert "<b>four" not in everything
    assert 'data-strip="/clip/0.webp" data-frames="3"' in everything
    assert "style=" not in everything  # the policy of contents allows none


def test_the_page_is_there_in_german_too(visitor):
    browser = visitor()
    browser.post("/start", data={})
    page = browser.post("/language/de", data={"back": "/label"})
    assert page.url.path == "/label"
    assert "Links ist besser" in page.text
