"""What the command-line scripts share: schemas for Hydra, and errors that people can read."""

import logging
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from popl_rl.config import (
    CHANGEABLE,
    Config,
    EvaluateConfig,
    LabelConfig,
    MethodConfig,
    ServeConfig,
    changing_nothing,
    fixed,
    plain,
    unread,
    validate,
)
from popl_rl.interruption import Terminated, listening
from popl_rl.trainers.spelling import explained
from popl_rl.trainers.terminal import steady_terminal
from popl_rl.trainers.typed import as_typed, opened

__all__ = [
    "USER_ERRORS",
    "given_overrides",
    "prepare",
    "read_options",
    "register_schemas",
    "run_command",
]

#: Names of the configurations that are settings of a run.
_RUNS = ("train", "people")
#: Errors that mean the user can put it right; anything else is a defect and keeps its traceback.
USER_ERRORS = (
    HydraException,
    OmegaConfBaseException,
    ValueError,
    TypeError,
    OSError,
    BrokenProcessPool,  # a killed worker, mostly for want of memory
)


def register_schemas() -> None:
    """Make the dataclasses of ``popl_rl.config`` known to Hydra."""
    store = ConfigStore.instance()
    # Hydra copies all of them at each look-up of a file and changes no copy: 1.5 s of --help.
    setattr(ConfigStore, "__deepcopy__", lambda known, _memo: known)  # noqa: B010 - it has none
    store.store(name="schema", node=Config)
    store.store(name="evaluate_schema", node=EvaluateConfig)
    store.store(name="label_schema", node=LabelConfig)
    store.store(name="serve_schema", node=ServeConfig)


def run_command(main: Callable[[], Any], schema: type = Config) -> None:
    """Run a Hydra main function and leave with the right exit code.

    0 when it worked, 2 when the user can put it right (bad option, file or value), 130 after
    Ctrl-C, 143 after SIGTERM, 1 for a defect of ours. ``HYDRA_FULL_ERROR=1`` shows the traceback
    of user errors too.

    Args:
        main: The function.
        schema: Dataclass of its settings, which what is misspelt is compared with.
    """
    with steady_terminal():
        _run(main, schema)


def _run(main: Callable[[], Any], schema: type) -> None:
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    sys.argv[1:] = opened(sys.argv[1:])  # which Hydra reads
    if os.environ.get("HYDRA_FULL_ERROR") == "1":
        main()
        return
    # Without this Hydra prints errors its own way and leaves with 1, whatever they are.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        sys.argv[1:] = as_typed(sys.argv[1:], schema)
        with listening():
            main()
    except (KeyboardInterrupt, Terminated) as stop:
        word, code = ("terminated", 143) if isinstance(stop, Terminated) else ("interrupted", 130)
        cure = next(iter(getattr(stop, "__notes__", [])), "the same command begins anew")
        _print_error(f"\n{word}; {cure}")
        sys.exit(code)
    except USER_ERRORS as error:
        _print_error(f"error: {explained(error, schema)}")
        sys.exit(2)
    finally:
        _forget_sweep()
        del os.environ["HYDRA_FULL_ERROR"]


def _forget_sweep() -> None:
    """Remove the copy of its settings that Hydra leaves of a sweep: each run has its own."""
    folder = Path("runs", ".sweep")
    if not folder.is_dir():
        return
    (folder / "multirun.yaml").unlink(missing_ok=True)
    for empty in (folder, folder.parent):
        with suppress(OSError):  # a launcher's logs, or runs
            empty.rmdir()


def prepare(config: Any, given: Sequence[str] | None = None) -> Config:
    """The settings of a run as dataclasses, after every check that needs nothing but them.

    Args:
        config: What Hydra composed, or the dataclass.
        given: Overrides that were typed; those of Hydra's command line if None.

    Raises:
        ValueError: Listing every problem, also settings given on the command line that the chosen
            method does not read, that change nothing, or that a run which is resumed has already.
    """
    settings: Config = plain(config)
    given = given_overrides() if given is None else given
    if settings.resume is not None:
        refused = fixed(given)
        if refused:
            raise ValueError(
                f"resume={settings.resume} goes on with the settings of that run, so that "
                f"{', '.join(refused)} cannot be given; beside resume= there may be "
                f"{', '.join(CHANGEABLE)}. Leave the others out, or start another run"
            )
        return settings
    validate(settings)
    problems = [*changing_nothing(given), *unread(given, settings.method, _readers())]
    if problems:
        raise ValueError("settings that nobody reads:\n  " + "\n  ".join(problems))
    return settings


def read_options(given: Sequence[str]) -> dict[str, Any]:
    """Options of a command as a dictionary; values are read as YAML reads them.

    Args:
        given: Texts ``name=value``.

    Raises:
        ValueError: If a text is none such.
    """
    found: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ValueError(f"options must be name=value, got {text!r}")
        found[name] = yaml.safe_load(value) if value else None
    return found


def given_overrides() -> list[str]:
    """Overrides of the command line, if Hydra has read one that is of a run."""
    from hydra.core.hydra_config import HydraConfig

    # A benchmark starts runs too, and what was typed is not theirs.
    if not HydraConfig.initialized() or HydraConfig.get().job.config_name not in _RUNS:
        return []
    return [str(override) for override in HydraConfig.get().overrides.task]


@cache
def _readers() -> dict[str, list[str]]:
    """Sections that each shipped method reads, by its name."""
    found = {}
    for entry in files("popl_rl.configs.method").iterdir():
        if entry.name.endswith(".yaml"):
            content: Any = OmegaConf.create(entry.read_text(encoding="utf-8"))
            given = {name: content[name] for name in ("factory", "reads") if name in content}
            found[entry.name.removesuffix(".yaml")] = MethodConfig(**given).sections()
    return dict(sorted(found.items()))


def _print_error(text: str) -> None:
    print(text, file=sys.stderr)
