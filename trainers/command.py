"""What the command-line scripts share: schemas for Hydra, and errors that people can read."""

import logging
import os
import sys
from collections.abc import Callable
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from popl_rl.config import Config, EvaluateConfig

__all__ = ["USER_ERRORS", "register_schemas", "run_command"]

#: Errors that mean the user can put it right; anything else is a defect and keeps its traceback.
USER_ERRORS = (HydraException, OmegaConfBaseException, ValueError, TypeError, OSError)


def register_schemas() -> None:
    """Make the dataclasses of :mod:`popl_rl.config` known to Hydra."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    store.store(name="evaluate_schema", node=EvaluateConfig)


def run_command(main: Callable[[], Any]) -> None:
    """Run a Hydra main function and leave with the right exit code.

    0 when it worked, 2 when the user can put it right (bad option, file or value), 130 after
    Ctrl-C, 1 for a defect of ours. ``HYDRA_FULL_ERROR=1`` shows the traceback of user errors too.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if os.environ.get("HYDRA_FULL_ERROR") == "1":
        main()
        return
    # Without this Hydra prints errors its own way and leaves with 1, whatever they are.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    errors = Console(stderr=True)
    try:
        main()
    except KeyboardInterrupt:
        errors.print("\ninterrupted; continue with resume=<folder of the run>", markup=False)
        sys.exit(130)
    except USER_ERRORS as error:
        errors.print(f"error: {error}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)
    finally:
        del os.environ["HYDRA_FULL_ERROR"]
