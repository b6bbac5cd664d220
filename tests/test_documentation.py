"""Every block, command, link, setting and table of the README files holds."""

import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from popl_rl.config import Config, LabelConfig, ServeConfig
from popl_rl.experiments.tables import fill_tables, make_tables, read_tables
from popl_rl.testing import check_env, check_rater
from popl_rl.testing.command import main as check
from popl_rl.trainers import train_popl

ROOT = Path(__file__).parents[1]
READMES = [Path(f, "README.md") for f in ("", "popl_rl", "envs", "trainers", "configs", "tests")]
PAGES = [
    *READMES,
    *(Path(".github", name) for name in ("CONTRIBUTING.md", "CHANGELOG.md", "CLUSTERS.md")),
]
TEXT = {page: (ROOT / page).read_text(encoding="utf-8") for page in PAGES}
CONFIGS = {
    "popl-train": "train",
    "popl-evaluate": "evaluate",
    "popl-benchmark": "benchmark",
    "popl-label": "label",
    "popl-serve": "serve",
    "popl-people": "people",
}
NOT_TRAINING = ("method.popl.", "method.refinement.", "method.mixture.")


def blocks(page, language):
    found = re.findall(rf"^```{language}\n(.*?)^```", TEXT[page], re.MULTILINE | re.DOTALL)
    return [block.replace("\\\n", " ") if language == "bash" else block for block in found]


def block_with(page, what):
    """The one Python block of a page that defines something."""
    [block] = [block for block in blocks(Path(page), "python") if what in block]
    return block


LINES = [
    line.strip() for page in PAGES for block in blocks(page, "bash") for line in block.split("\n")
]
#: With files of one's own beside them, which are tried in tests/trainers/test_new_env.py.
OWN = "--config-dir"
COMMANDS = sorted({line for line in LINES if line.startswith(tuple(CONFIGS)) and OWN not in line})
LAUNCHED = sorted({line for line in LINES if line.startswith(("python -m", "python tests"))})


@pytest.fixture(scope="module")
def folder_with_a_run(tmp_path_factory, finished):
    """A folder in which README files' ``runs/mine`` is a finished run."""
    folder = tmp_path_factory.mktemp("documented")
    shutil.copytree(finished.run_dir, folder / "runs" / "mine")
    return folder


def test_the_readme_shows_everything_and_is_short():
    readme = TEXT[Path("README.md")]
    assert len(readme.splitlines()) <= 170
    assert blocks(Path("README.md"), "python")
    for page in READMES[1:]:
        assert f"({page.parent}/{page.name})" in readme
    assert len(COMMANDS) > 40


@pytest.mark.parametrize("page", READMES, ids=str)
def test_python_blocks_run(page, folder_with_a_run, monkeypatch):
    monkeypatch.chdir(folder_with_a_run)
    namespace = {"__name__": "documented"}
    for code in blocks(page, "python"):
        exec(compile(code, str(page), "exec"), namespace)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_name_settings_that_exist(command, config_of):
    program, *arguments = shlex.split(command, comments=True)
    # A sweep's comma-separated values are Hydra's business; each one alone must fit.
    sweep = "-m" in arguments or "--multirun" in arguments
    overrides = [argument for argument in arguments if not argument.startswith("-")]
    # Launchers are plug-ins that need not be installed.
    overrides = [o for o in overrides if not o.startswith(("hydra/launcher=", "hydra.launcher."))]
    if sweep:
        overrides = [first_value(override) for override in overrides]
    assert config_of(*overrides, name=CONFIGS[program])


def first_value(override):
    name, _, value = override.partition("=")
    if value.startswith("range("):
        value = value.removeprefix("range(")
    return override if value.startswith(("[", "{", "'", '"')) else f"{name}={value.split(',')[0]}"


@pytest.mark.parametrize("command", LAUNCHED)
def test_scripts_that_are_launched_exist(command):
    _, *arguments = shlex.split(command, comments=True)
    if arguments[0] == "-m":
        assert find_spec(arguments[1])
    else:
        assert (ROOT / arguments[0]).is_file()
    for path in (argument for argument in arguments[1:] if argument.startswith("tests/")):
        assert (ROOT / path).is_file()


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_lead_somewhere(page):
    anchors = re.compile(r"^#+ (.*)$", re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXT[page]):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        found = (ROOT / page).parent / path if path else ROOT / page
        assert found.exists(), target
        if anchor:
            titles = anchors.findall(found.read_text(encoding="utf-8"))
            made = [re.sub(r"[^\w\- ]", "", title).strip().lower() for title in titles]
            assert anchor in [title.replace(" ", "-") for title in made], target


def test_tables_are_what_their_rows_say():
    folder = ROOT / "configs" / "results"
    tables = make_tables(read_tables(folder / "tables.toml"), folder)
    shown = {page: fill_tables(TEXT[page], tables) for page in READMES}
    wrong = [str(page) for page in READMES if shown[page] != TEXT[page]]
    assert wrong == [], "run python -m popl_rl.trainers.make_tables"


def settings_of(section, prefix=""):
    """Names of the settings of a section, sections in it included."""
    for field in fields(section):
        value = getattr(section, field.name)
        if is_dataclass(value):
            yield from settings_of(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}"


def documented_settings(section):
    """Names in the first column of a section's table; ``name...`` stands for all that begin so."""
    text = TEXT[Path("configs/README.md")]
    [chapter] = re.findall(rf"^## `{section}`.*?(?=^## )", text, re.MULTILINE | re.DOTALL)
    [table] = re.findall(r"^\| setting \|.*?\n\n", chapter, re.MULTILINE | re.DOTALL)
    cells = [line.split("|")[1] for line in table.splitlines()[2:] if line]
    return [name for cell in cells for name in re.findall(r"`([\w.]+)`", cell)]


@pytest.mark.parametrize(
    ("schema", "section"),
    [
        *((Config, section) for section in ("raters", "data", "method", "people", "evaluation")),
        (LabelConfig, "label"),
        (LabelConfig, "page"),
        (ServeConfig, "serve"),
    ],
)
def test_every_setting_is_documented_and_exists(schema, section):
    existing = set(settings_of(getattr(schema(), section)))
    named = documented_settings(section)
    whole = tuple(name.removesuffix("...") + "." for name in named if name.endswith("..."))
    assert {name for name in existing - set(named) if not name.startswith(whole or "-")} == set()
    assert {name for name in named if not name.endswith("...")} - existing == set()


def test_the_environment_and_the_raters_shown_can_be_used(config_of, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(block_with("envs/README.md", "class Line"))
    Path("my_raters.py").write_text(block_with("envs/README.md", "def left"))
    check_env("line.py:Line")
    check_rater("my_raters.py:left", "line.py:Line")
    own = ["env=custom", "env.factory=line.py:Line", "raters.label=return"]
    groups = "raters.groups=[my_raters.py:left, my_raters.py:right]"
    result = train_popl.run(config_of(*own, groups, *tiny[1:], "env.success=right", "run_dir=run"))
    assert set(result.board.results.group) >= {"left", "right"}


def test_the_data_shown_can_be_learnt_from(config_of, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(block_with("popl_rl/README.md", "my_data"), {})
    [command] = [command for command in COMMANDS if "data.load=my_data" in command]
    loaded = [*shlex.split(command)[1:], "evaluation.pairs=12"]  # all that there are
    result = train_popl.run(config_of(*tiny[1:], *loaded, "run_dir=run"))
    assert len(result.policies) >= 1


@pytest.mark.parametrize(
    ("what", "file"), [("class NoisyLexicase", "my_method.py"), ("def lucky_case", "my_rules.py")]
)
def test_plug_ins_of_the_method_can_be_used(what, file, config_of, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(file).write_text(block_with("popl_rl/README.md", what))
    [command] = [command for command in COMMANDS if file in command]
    overrides = shlex.split(command)[1:]
    # A setting of a section that the method does not read is refused.
    read = [o for o in tiny if what != "class NoisyLexicase" or not o.startswith(NOT_TRAINING)]
    result = train_popl.run(config_of(*read, *overrides, "run_dir=run"))
    assert len(result.policies) >= 1
    [checked] = [command for command in LAUNCHED if file in command]
    assert check(shlex.split(checked)[3:]) == 0


def test_the_reader_shown_can_be_used(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_reader.py").write_text(block_with("popl_rl/README.md", "def read"))
    rows = {"observation": (6, 12, 18), "goal": (6, 12)}
    columns = {name: np.zeros(shape, dtype=np.float32) for name, shape in rows.items()}
    columns |= {"action": np.ones((6, 12), int), "pair": np.arange(6).reshape(3, 2)}
    np.savez("answers.npz", **columns, answer=np.array([0, 1, 3]), rater=np.array([0, 0, 7]))
    [checked] = [command for command in LAUNCHED if "my_reader.py" in command]
    assert check(shlex.split(checked)[3:]) == 0


def test_docstrings_name_things_as_the_reference_links_them():
    """In backticks, with dots where they are elsewhere: pdoc shows Sphinx's roles as they stand."""
    folders = ("popl_rl", "envs", "trainers", "configs", "tests")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found = {
        str(path.relative_to(ROOT)): re.findall(r":[a-z]+:`[^`]+`", path.read_text("utf-8"))
        for path in paths
    }
    assert {path: roles for path, roles in found.items() if roles} == {}


@pytest.mark.docs
def test_the_reference_builds_without_warnings(tmp_path):
    [command] = [
        line
        for block in blocks(Path(".github/CONTRIBUTING.md"), "bash")
        for line in block.splitlines()
        if "pdoc.cli()" in line
    ]
    _, *arguments = shlex.split(command.replace(" -o reference ", f" -o {tmp_path} "))
    done = subprocess.run(
        [sys.executable, *arguments],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    assert "warn" not in done.stderr.lower(), done.stderr
    assert (tmp_path / "popl_rl" / "selection" / "lexicase.html").is_file()
    shown = (tmp_path / "popl_rl" / "algorithms" / "trainer.html").read_text("utf-8")
    assert 'href="popl.html#POPL.step"' in shown.replace("../algorithms/", "")
    # A package that is new must be named in the command too.
    packages = {path.parent.name for path in (ROOT / "popl_rl").glob("*/__init__.py")}
    assert packages <= {path.stem for path in (tmp_path / "popl_rl").glob("*.html")}
