import csv
import io
import re

import pytest
import torch
from starlette.testclient import TestClient

from popl_rl.web.catering import Caterer
from popl_rl.web.clips import Clip
from popl_rl.web.guards import guards
from popl_rl.web.numbers import Number
from popl_rl.web.pages import Pages
from popl_rl.web.person_store import PersonStore
from popl_rl.web.serve_app import ServePages

PAIRS = torch.tensor([(first, second) for first in range(8) for second in range(first)])


@pytest.fixture
def caterer(policies, steps, tmp_path):
    store = PersonStore(tmp_path / "answers.sqlite")
    yield Caterer(
        policies,
        steps,
        PAIRS,
        everybody=policies.subset([1]),
        store=store,
        questions=3,
        enough=0.999,
        further=2,
    )
    store.database.close()


@pytest.fixture
def visitor(caterer):
    clips = {index: Clip(2, 10.0, b"strip") for index in range(8)}
    clips |= {9: Clip(5, 10.0, b"own"), 10: Clip(text="text of the other")}
    clips[11] = Clip(5, 10.0, b"everybody")
    pages = ServePages(
        caterer,
        Pages(clips, language="en"),
        shows=lambda member: [11 if member is None else 9 + member],
        numbers=[Number("m_success", torch.tensor([0.25, 0.5]), 0.75)],
        word="secret",
    )
    app = pages.app(guards(hosts=("testserver",), key=None, rate=100, newcomers=100))
    return lambda: TestClient(app)


def prefer(browser, page, action):
    """Answer as somebody who wants this action: it is that of segments with its parity."""
    [position] = re.findall(r'name="position" value="(\d+)"', page.text)
    first, second = map(int, re.findall(r'data-strip="/clip/(\d+)\.webp"', page.text))
    assert first != second
    value = "first" if first % 2 == action else "second"
    return browser.post("/answer", data={"position": position, "answer": value})


def find(browser, action):
    page, beliefs = browser.post("/start", data={}), []
    while page.url.path == "/find":
        beliefs.append(re.findall(r'width="([\d.]+)" data-before="([\d.]+)"', page.text))
        page = prefer(browser, page, action)
    return page, beliefs


@pytest.mark.parametrize("action", [0, 1])
def test_a_person_finds_a_policy(visitor, action):
    browser = visitor()
    assert "at most 3 times" in browser.get("/").text
    page, beliefs = find(browser, action)
    assert page.url.path == "/policy"
    assert f"Policy {action + 1} is yours with 100 % belief" in page.text
    assert "agrees with 3 of your 3 choices" in page.text
    assert ("text of the other" in page.text) == (action == 1)
    assert "/clip/11.webp" in page.text
    assert ('<td class="number">0.25</td>' in page.text) == (action == 0)
    assert '<td class="number">0.75</td>' in page.text
    # The bars begin alike, and move towards the right one; each from where it was before.
    now = [[float(width) for width, _ in bars] for bars in beliefs]
    assert now[0] == [50.0, 50.0]
    assert now[2][action] > now[1][action] > 50
    assert [float(before) for _, before in beliefs[2]] == now[1]


def test_whether_it_suits_is_kept(visitor, caterer):
    browser = visitor()
    assert browser.post("/verdict", data={"suits": "no"}).status_code == 409
    browser.post("/start", data={})
    assert browser.post("/verdict", data={"suits": "no"}).status_code == 409
    page, _ = find(browser, 0)
    assert "None of these suits me" in page.text
    assert browser.post("/verdict", data={"suits": "perhaps"}).status_code == 400
    page = browser.post("/verdict", data={"suits": "no"})
    assert "your answer is kept" in page.text
    [_, row] = caterer.rows()
    assert row["suits"] is False


def test_further_pairs_tell_whether_it_agrees(visitor):
    browser = visitor()
    find(browser, 0)
    page = browser.get("/further")
    for number in (1, 2):
        assert f"Another pair, {number} of 2" in page.text
        page = prefer(browser, page, 0)
    assert re.search(r"agrees with (\d) of your 2 further choices", page.text)
    assert browser.get("/find").url.path == "/policy"


def test_reload_undo_and_second_clicks(visitor):
    browser = visitor()
    page = browser.post("/start", data={})
    assert browser.get("/find").text == page.text
    later = prefer(browser, page, 0)
    assert later.text != page.text
    again = browser.post("/answer", data={"position": 1, "answer": "second"})
    assert again.text == later.text
    assert browser.post("/undo").text == page.text


@pytest.mark.parametrize("position", ["2", "x", "", "9" * 30])
def test_what_was_not_asked_is_refused(visitor, position):
    browser = visitor()
    browser.post("/start", data={})
    wrong = browser.post("/answer", data={"position": position, "answer": "first"})
    assert wrong.status_code in (400, 409)


def test_strangers_are_sent_to_the_first_page(visitor):
    browser = visitor()
    for path in ("/find", "/policy", "/further"):
        assert browser.get(path).url.path == "/"
    for path in ("/answer", "/undo", "/verdict"):
        assert browser.post(path, data={}).status_code == 409
    browser.post("/start", data={})
    for path in ("/policy", "/further"):
        assert browser.get(path).url.path == "/find"


def test_researchers_see_who_was_served_what(visitor, caterer):
    researcher = visitor()
    for path in ("/researcher", "/researcher.csv", "/researcher.json"):
        assert researcher.get(path).status_code == 404
        assert researcher.get(f"{path}?pass=guess").status_code == 404
    assert "Nobody yet" in researcher.get("/researcher?pass=secret").text
    assert researcher.get("/researcher.csv?pass=secret").text == ""
    for action in (0, 1):
        find(visitor(), action)
    rows = researcher.get("/researcher.json?pass=secret").json()
    assert [row["member"] for row in rows] == [0, 1]
    assert [len(row["asked"]) for row in rows] == [3, 3]
    table = list(csv.DictReader(io.StringIO(researcher.get("/researcher.csv?pass=secret").text)))
    assert [row["member"] for row in table] == ["0", "1"]
    assert "asked" not in table[0]
    assert "3" in researcher.get("/researcher?pass=secret").text


def test_the_interface_for_programs(visitor):
    program = visitor()
    token = program.post("/api/start").json()["token"]
    program.headers["authorization"] = f"Bearer {token}"
    assert program.get("/api/policy").status_code == 409
    state = program.get("/api/next").json()
    assert state["belief"] == [0.5, 0.5]
    while not state["over"]:
        question = state["question"]
        first, _ = question["pair"]
        assert question["clips"][0] == {
            "strip": f"/clip/{first}.webp",
            "frames": 2,
            "rate": 10.0,
            "text": "",
        }
        reply = "first" if first % 2 == 1 else "second"
        said = {"position": question["position"], "answer": reply, "seconds": 1}
        state = program.post("/api/answer", json=said).json()
    assert state["question"] is None
    found = program.get("/api/policy").json()
    assert (found["member"], found["agrees"], found["strict"]) == (1, 3, 3)
    assert found["numbers"] == [{"name": "m_success", "about": {}, "own": 0.5, "everybody": 0.75}]
    assert found["clips"][0]["text"] == "text of the other"


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        ({"content": b"{"}, 400),
        ({"content": b"[1]"}, 400),
        ({"json": {"position": "1", "answer": "first"}}, 400),
        ({"json": {"position": True, "answer": "first"}}, 400),
        ({"json": {"position": 1, "answer": "third"}}, 400),
        ({"json": {"position": 2, "answer": "first"}}, 409),
        ({"json": {"position": 10**30, "answer": "first"}}, 409),
    ],
)
def test_the_interface_refuses_and_says_why(visitor, sent, status):
    program = visitor()
    assert program.get("/api/next").status_code == 401
    assert program.get("/api/next", headers={"authorization": "Bearer x"}).status_code == 401
    token = program.post("/api/start").json()["token"]
    headers = {"authorization": f"Bearer {token}"}
    program.get("/api/next", headers=headers)
    response = program.post("/api/answer", headers=headers, **sent)
    assert response.status_code == status
    assert response.json()["error"]
