"""A real browser on both pages (``-m browser``): Debian's chromium, driven by Playwright."""

import re
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pandas as pd
import pytest
import torch

from popl_rl.config import EnvConfig
from popl_rl.evaluation.optimum import ExactReturns
from popl_rl.experiments.data import build_world
from popl_rl.models.policy_set import PolicySet
from popl_rl.raters.groups import make_groups
from popl_rl.storage import load_tensordict
from popl_rl.trainers import train_popl

pytestmark = [pytest.mark.browser, pytest.mark.timeout(1200)]

CHROMIUM = shutil.which("chromium")
DESKTOP, PHONE = {"width": 1100, "height": 800}, {"width": 390, "height": 780}
ROOM = "env.options.size=7"
RATERS, ANSWERS = 12, 60


@contextmanager
def server(module, *overrides):
    """A command of ours, until its page is there and for as long as it is needed: its address."""
    command = [sys.executable, "-m", f"popl_rl.trainers.{module}", *overrides, "page.port=0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    said = []
    try:
        for line in process.stdout:
            said.append(line)
            if "Ctrl-C ends it" in line:
                break
        else:
            raise AssertionError(f"{command} ended at once: {said}")
        yield re.search(r"http://\S+", said[0])[0], said
    finally:
        process.send_signal(2)
        process.wait(30)
        process.stdout.close()


@pytest.fixture(scope="module")
def chromium():
    if CHROMIUM is None:
        pytest.skip("chromium is not installed: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def visit(chromium):
    """Opens a page in a browser of its own; whatever the browser complains of fails the test."""
    problems, contexts = [], []

    def open_page(url, **settings):
        contexts.append(chromium.new_context(**{"viewport": DESKTOP, **settings}))
        page = contexts[-1].new_page()
        page.set_default_timeout(30_000)
        page.on("console", lambda said: problems.append(said.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(url)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []


@pytest.fixture(scope="module")
def labels(tmp_path_factory):
    """A page for labelling a small room: its address and folder."""
    out = tmp_path_factory.mktemp("labels") / "labels"
    settings = [f"out={out}", ROOM, "data.segments=200", "label.count=800", "label.attention=6"]
    settings += ["label.raters_per_pair=2", "page.rate=200", f"label.answers={ANSWERS}"]
    with server("label_pairs", *settings, "label.pause=25") as (url, _):
        yield url, out


def ready(page):
    page.wait_for_selector("#answers[data-ready]")


def begin(page):
    page.get_by_role("button", name="Begin").click()
    ready(page)


def question(page):
    """Number of the open question, and the segments on its left and right."""
    position = page.locator("input[name=position]").input_value()
    strips = page.locator("canvas").evaluate_all("all => all.map(one => one.dataset.strip)")
    return position, *(int(re.search(r"(\d+)\.webp", strip)[1]) for strip in strips)


def press(page, key):
    """Press a key and wait for the next page."""
    with page.expect_navigation():
        page.keyboard.press(key)


def fits(page):
    """Whether nothing is wider than the window."""
    return page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_ten_pairs_by_keys_undo_reload_and_coming_back(labels, visit):
    url, _ = labels
    page = visit(url)
    page.keyboard.press("Tab")
    page.get_by_label("Name or number").fill("Ann")
    with page.expect_navigation():
        page.keyboard.press("Enter")
    ready(page)
    asked = question(page)
    press(page, "ArrowLeft")
    ready(page)
    press(page, "Backspace")
    ready(page)
    assert question(page) == asked
    seen = set()
    for key in ["ArrowLeft", "ArrowRight", "ArrowDown", "Space"] * 3:
        ready(page)
        seen.add(question(page))
        press(page, key)
    ready(page)
    assert len(seen) == 12  # eleven pairs and a check
    assert f"Question 12 of {ANSWERS}" in page.title()
    asked = question(page)
    page.reload()
    ready(page)
    assert question(page) == asked
    later = page.context.new_page()  # the same rater comes back
    later.goto(url)
    later.get_by_role("link", name="Go on").click()
    ready(later)
    assert question(later) == asked


def test_both_clips_are_in_step_and_can_be_stopped(labels, visit):
    page = visit(labels[0])
    begin(page)
    frames = "all => all.map(one => [one.dataset.frame, one.width, one.height])"
    shown = []
    for _ in range(12):
        page.wait_for_timeout(90)
        left, right = page.locator("canvas").evaluate_all(frames)
        assert left == right
        shown.append(left[0])
    assert len(set(shown)) > 4
    page.get_by_role("button", name="Stop").click()
    stopped = page.locator("canvas").evaluate_all(frames)
    page.wait_for_timeout(400)
    assert page.locator("canvas").evaluate_all(frames) == stopped


def test_nothing_moves_for_people_whom_motion_disturbs(labels, visit):
    page = visit(labels[0], reduced_motion="reduce")
    begin(page)
    frames = "all => all.map(one => one.dataset.frame)"
    still = page.locator("canvas").evaluate_all(frames)
    page.wait_for_timeout(400)
    assert page.locator("canvas").evaluate_all(frames) == still == ["12", "12"]
    page.get_by_role("button", name="Play").click()
    page.wait_for_timeout(300)
    assert page.locator("canvas").evaluate_all(frames) != still


def test_a_phone_in_german_shows_everything(labels, visit):
    page = visit(labels[0], viewport=PHONE)
    assert fits(page)
    page.get_by_role("button", name="DE").click()
    page.get_by_role("button", name="Beginnen").click()
    ready(page)
    assert fits(page)
    names = ["Links ist besser", "Rechts ist besser", "Gleich gut", "Überspringen"]
    for name in names:
        box = page.get_by_role("button", name=name).bounding_box()
        assert box["y"] + box["height"] <= PHONE["height"]


@pytest.fixture(scope="module")
def utilities(labels):
    """Regret of every segment to both groups, ``[2, N]``, by which scripted people answer."""
    segments = load_tensordict(labels[1] / "segments")
    segments.auto_batch_size_(2)
    world = build_world(EnvConfig(options={"size": 7}))
    groups = make_groups(["upper", "lower"], label="regret", table=world.table)
    return torch.stack([group.segment_utility(segments) for group in groups])


def answer_as(page, utility):
    """Answer a question as somebody of a group; a check as it asks."""
    ready(page)
    heading = page.get_by_role("heading", level=1).inner_text()
    if "please choose" in heading:
        key = "ArrowLeft" if "left" in heading else "ArrowRight"
    else:
        _, left, right = question(page)
        difference = float(utility[left] - utility[right])
        key = "ArrowDown" if abs(difference) < 1e-6 else "ArrowLeft"
        key = "ArrowRight" if difference <= -1e-6 else key
    press(page, key)


@pytest.mark.slow  # many minutes of answers
def test_people_label_a_set_is_trained_and_each_finds_a_policy(
    labels, utilities, visit, config_of, tmp_path
):
    url, out = labels
    for rater in range(RATERS):
        page = visit(url)
        begin(page)
        while not page.url.endswith("/done"):
            if page.url.endswith("/pause"):
                page.get_by_role("link", name="Go on").click()
            answer_as(page, utilities[rater % 2])
        assert re.fullmatch("[0-9A-F]{8}", page.locator(".code").inner_text())
        page.context.close()
    page = visit(url)
    page.wait_for_timeout(6000)  # answers become data every five seconds
    run_dir = tmp_path / "run"
    settings = [ROOM, f"data.load={out}", "data.segments=200", "evaluation.baselines=false"]
    settings += ["method.generations=20", "method.members=16", "method.training.steps=1500"]
    train_popl.run(config_of(*settings, "logger=csv", f"run_dir={run_dir}"))
    results = pd.read_csv(run_dir / "results.csv")
    best = results[results.measure == "best_share_of_optimum"].set_index("group")["value"]
    assert (best[["upper", "lower"]] > 0.5).all(), best

    policies = PolicySet.load(run_dir / "policies")
    world = build_world(EnvConfig(options={"size": 7}))
    groups = make_groups(["upper", "lower"], label="regret", table=world.table)
    exact = ExactReturns(world.table, groups, horizon=60)
    returns = exact(policies)
    with server("serve_policies", f"run_dir={run_dir}", "page.rate=200") as (url, said):
        found = [_find(visit, url, utilities[index]) for index in range(2)]
        for index, member in enumerate(found):
            share = exact.share_of_optimum(index, float(returns[member, index]))
            assert share > 0.5, (index, found, returns)
        page = visit(re.search(r"http://\S+", said[1])[0].rstrip(";"))
        assert page.locator("tbody tr").count() == 2
        assert page.get_by_text("none suits").count() == 2


def _find(visit, url, utility):
    """The policy that somebody of a group finds; a look at every page, also on a phone."""
    page = visit(url)
    begin(page)
    questions = 0
    while page.url.endswith("/find"):
        answer_as(page, utility)
        questions += 1
    assert questions <= 5
    assert page.url.endswith("/policy")
    assert page.locator("canvas").count() == 2
    member = int(re.search(r"Policy (\d+) is yours", page.locator("main").inner_text())[1]) - 1
    page.set_viewport_size(PHONE)
    assert fits(page)
    page.get_by_role("button", name="None of these suits me").click()
    page.get_by_text("your answer is kept").wait_for()
    page.get_by_role("link", name="Compare 5 more").click()
    for _ in range(5):
        answer_as(page, utility)
    assert "of your" in page.locator("main").inner_text()
    page.context.close()
    return member
