import pickle
import sys
from importlib.metadata import EntryPoint

import pytest

from popl_rl import registry
from popl_rl.registry import env, names, rater, resolve

GOOD = """
from popl_rl.registry import rater
LIMIT = 3
runs = []
runs.append(1)

@rater("tender")
def tender(segments):
    return segments

class Strict:
    pass

def brisk(segments):
    return segments
"""


@pytest.fixture(autouse=True)
def clean_registry():
    """Each test sees what installed packages declare, and leaves nothing behind."""
    before = set(sys.modules)
    with registry.isolated():
        yield
    for name in set(sys.modules) - before:
        if name.startswith("popl_rl_file_"):
            del sys.modules[name]


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "my_raters.py"
    path.write_text(GOOD)
    return path


def test_a_decorated_function_is_unchanged_and_found_by_name():
    def hasty(segments):
        return segments

    assert rater("hasty")(hasty) is hasty
    assert resolve("rater", "hasty") is hasty
    assert "hasty" in names("rater")


def test_kinds_have_names_of_their_own():
    def shared():
        return None

    rater("shared")(shared)
    with pytest.raises(ValueError, match="unknown env 'shared'"):
        resolve("env", "shared")


def test_built_ins_are_found_through_entry_points():
    assert "two_doors" in names("env")
    assert {"upper", "lower", "third", "fourth"} <= set(names("rater"))
    assert resolve("env", "two_doors").__module__ == "popl_rl.envs.two_doors"
    assert names("rater") == sorted(names("rater"))


def test_a_taken_name_is_an_error():
    @rater("mine")
    def first(segments):
        return segments

    def second(segments):
        return segments

    with pytest.raises(ValueError, match=r"'mine' is taken by .*first in .*choose another"):
        rater("mine")(second)


def test_a_name_of_an_installed_package_is_taken_before_it_is_loaded():
    with pytest.raises(ValueError, match=r"'upper' is taken by upper in .*two_doors.py"):

        @rater("upper")
        def other(segments):
            return segments


def test_a_reload_may_register_again():
    def define():
        @rater("again")
        def again(segments):
            return segments

        return again

    define()
    newer = define()
    assert resolve("rater", "again") is newer


def test_module_and_attribute():
    assert resolve("rater", "popl_rl.envs.two_doors:lower") is resolve("rater", "lower")


def test_file_and_attribute(file, monkeypatch):
    brisk = resolve("rater", "my_raters.py:brisk")
    assert brisk(3) == 3
    assert resolve("rater", f"{file}:brisk") is brisk
    assert resolve("rater", "tender") is resolve("rater", "my_raters.py:tender")
    assert sys.modules[brisk.__module__].runs == [1]
    assert pickle.loads(pickle.dumps(brisk)) is brisk


def test_two_files_of_one_name_are_two_modules(file, tmp_path):
    other = tmp_path / "sub" / "my_raters.py"
    other.parent.mkdir()
    other.write_text("def brisk(segments):\n    return -1\n")
    assert resolve("rater", "sub/my_raters.py:brisk")(0) == -1
    assert resolve("rater", "my_raters.py:brisk")(0) == 0


def test_an_unknown_name_answers_with_the_nearest_the_list_and_the_forms():
    with pytest.raises(ValueError, match=r"unknown rater 'uper'") as caught:
        resolve("rater", "uper")
    message = str(caught.value)
    assert "Did you mean 'upper'?" in message
    assert "fourth, " in message
    for form in ("registered name", "package.module:attr", "path/file.py:attr"):
        assert form in message


def test_a_missing_attribute_lists_what_there_is(file):
    with pytest.raises(ValueError, match=r"no 'brsk'. Did you mean 'brisk'\?") as caught:
        resolve("rater", "my_raters.py:brsk")
    assert "It defines: Strict, brisk, tender." in str(caught.value)


def test_a_missing_file_lists_its_folder(file):
    with pytest.raises(ValueError, match=r"no Python file .*raters\.py\..*: my_raters\.py\."):
        resolve("rater", "raters.py:tender")
    with pytest.raises(ValueError, match=r"no Python file .*Python files in that folder: none"):
        resolve("rater", "nowhere/raters.py:tender")


def test_an_error_in_a_file_is_wrapped_and_the_file_can_be_mended(file):
    file.write_text("import json\njson.loads('{')\n")
    with pytest.raises(ValueError, match=r"my_raters.py:tender'.*JSONDecodeError") as caught:
        resolve("rater", "my_raters.py:tender")
    assert caught.value.__cause__ is not None
    file.write_text(GOOD)
    assert resolve("rater", "my_raters.py:tender")(1) == 1


def test_a_syntax_error_is_wrapped(file):
    file.write_text("def tender(:\n")
    with pytest.raises(ValueError, match="SyntaxError"):
        resolve("rater", "my_raters.py:tender")


def test_a_missing_module_suggests_the_file():
    with pytest.raises(ValueError, match=r"Is it installed, .*'no/such_one\.py:\.\.\.'"):
        resolve("rater", "no.such_one:tender")


def test_a_module_that_misses_another_is_not_called_missing(file, monkeypatch):
    monkeypatch.syspath_prepend(str(file.parent))
    (file.parent / "needs_more.py").write_text("import not_there_at_all\n")
    with pytest.raises(ValueError, match="No module named 'not_there_at_all'") as caught:
        resolve("rater", "needs_more:tender")
    assert "Is it installed" not in str(caught.value)


@pytest.mark.parametrize("reference", ["my_raters.py:", ":tender"])
def test_incomplete_references(file, reference):
    with pytest.raises(ValueError, match=r"is incomplete\. A reference is"):
        resolve("rater", reference)


def test_a_file_without_attribute_says_what_to_add(file):
    with pytest.raises(ValueError, match="names a file: add ':'"):
        resolve("rater", "my_raters.py")


def test_what_is_found_must_be_callable(file):
    with pytest.raises(TypeError, match=r"must name a function or class, got a int"):
        resolve("rater", "my_raters.py:LIMIT")


@pytest.mark.parametrize("name", ["", "a:b", None])
def test_names_are_checked(name):
    with pytest.raises(ValueError, match="@env needs a name without ':'"):
        env(name)


def test_a_forgotten_name_is_reported():
    with pytest.raises(ValueError, match=r"@rater needs a name.*@rater\('my_rater'\)"):

        @rater
        def tender(segments):
            return segments


def test_kind_and_type_of_a_reference_are_checked():
    known = r"\['behaviour', 'env', 'features', 'method', 'rater', 'reader', 'selection'\]"
    with pytest.raises(ValueError, match=f"kind must be one of {known}"):
        resolve("robot", "x")
    with pytest.raises(TypeError, match="must be a string, got int"):
        resolve("env", 3)


def test_two_packages_may_not_declare_one_name(monkeypatch):
    points = [EntryPoint("twin", f"package_{side}:twin", "popl_rl.env") for side in "ab"]
    monkeypatch.setattr(registry, "entry_points", lambda **_: points)
    with pytest.raises(ValueError, match=r"'twin' is declared by two installed packages"):
        names("env")


def test_what_is_registered_in_isolation_is_forgotten():
    before = names("rater")
    with registry.isolated():
        assert names("rater") == before

        @rater("passing")
        def passing(segments):
            return segments

        assert resolve("rater", "passing") is passing
    assert names("rater") == before


def test_a_file_may_use_a_name_of_another_world(tmp_path):
    """``file.py:name`` is the file's, by the name it is decorated with or its own."""
    path = tmp_path / "raters_of_mine.py"
    path.write_text(
        "from popl_rl import rater\n\n@rater('upper')\ndef mine(segments):\n    return segments\n"
    )
    by_name, by_function = resolve("rater", f"{path}:upper"), resolve("rater", f"{path}:mine")
    assert by_name is by_function
    assert resolve("rater", "upper").__module__ == "popl_rl.envs.two_doors"
    with pytest.raises(ValueError, match=r"has no 'uper'\. Did you mean 'upper'\?"):
        resolve("rater", f"{path}:uper")


def test_a_file_imports_what_is_beside_it(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    for number, folder in enumerate(("one", "two")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "helping_hand.py").write_text(f"NUMBER = {number}\n")
        (tmp_path / folder / "plug.py").write_text(
            "from helping_hand import NUMBER\n\ndef rate(segments):\n    return NUMBER\n"
        )
    try:
        assert resolve("rater", f"{tmp_path}/one/plug.py:rate")(None) == 0
        with pytest.raises(ValueError, match=r"imports 'helping_hand'.*one.*rename one"):
            resolve("rater", f"{tmp_path}/two/plug.py:rate")
    finally:
        sys.modules.pop("helping_hand", None)
