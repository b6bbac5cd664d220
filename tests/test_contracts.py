"""Every registered environment and rater keeps what check_env and check_rater ask for."""

import pytest

from popl_rl import registry
from popl_rl.testing import check_env, check_rater

ENVS = registry.names("env")
RATERS = registry.names("rater")


def home(rater):
    """An environment that is defined beside the rater; None if there is none."""
    module = registry.resolve("rater", rater).__module__
    found = [name for name in ENVS if registry.resolve("env", name).__module__ == module]
    return found[0] if found else None


def test_there_is_something_to_check():
    assert ENVS
    assert RATERS


@pytest.mark.parametrize("name", ENVS)
def test_environments(name):
    check_env(name)


@pytest.mark.parametrize("name", RATERS)
def test_raters(name):
    environment = home(name)
    assert environment is not None, f"no environment is defined beside rater {name!r}"
    check_rater(name, environment)
