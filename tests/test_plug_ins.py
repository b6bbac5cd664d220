"""Whatever a plug-in does is one error that names it, the file and the line."""

import functools
from pathlib import Path

import pytest

from popl_rl.plug_ins import PlugInError, call, defined, is_foreign, located
from popl_rl.selection.rules import random_selection


def leaves():
    raise SystemExit(0)


def fails():
    raise KeyError("odd")


def inner():
    return call("rater", "inner", "judging", fails)


def line_of(text):
    return 1 + Path(__file__).read_text().splitlines().index(text)


def test_what_is_raised_becomes_an_error_with_file_and_line():
    with pytest.raises(PlugInError) as caught:
        call("env", "mine", "reset", fails)
    line = line_of('    raise KeyError("odd")')
    assert str(caught.value) == (
        f"env 'mine': reset failed with KeyError: 'odd' ({__file__}, line {line})"
    )
    assert isinstance(caught.value.__cause__, KeyError)


def test_leaving_the_process_is_an_error_too():
    with pytest.raises(PlugInError, match=r"sys\.exit\(0\), which would end the run; raise an"):
        call("env", "mine", "step", leaves)


def test_arguments_that_do_not_fit_are_told_with_the_place_of_the_function():
    line = line_of("def fails():")
    with pytest.raises(PlugInError, match=rf"1 was given \({__file__}, line {line}\)"):
        call("env", "mine", "making it", fails, 1)


def test_the_innermost_plug_in_is_named_and_ctrl_c_passes():
    with pytest.raises(PlugInError, match=r"^rater 'inner': judging failed"):
        call("env", "outer", "step", inner)

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        call("env", "mine", "step", interrupted)


def test_what_is_returned_wrongly_is_told_with_the_place_of_the_plug_in():
    place = rf"no number \({__file__}, line {line_of('def fails():')}\)"
    with pytest.raises(TypeError, match=place), located(functools.partial(fails)):
        raise TypeError("no number")
    assert defined(3) == ""


def test_ours_and_others():
    assert is_foreign(fails)
    assert not is_foreign(random_selection)
