"""Begin a world of your own: ``popl-new``.

popl-new my_env.py
popl-train --config-dir . env=my_env

It writes a complete example, an environment with two groups of raters, behaviours and a table, and
its settings beside it, ``env/my_env.yaml``. Both run as they are, and are made to be changed.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from popl_rl.storage import write_atomic
from popl_rl.trainers.command import USER_ERRORS

__all__ = ["cli", "main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the example; returns the exit code."""
    parser = argparse.ArgumentParser("popl-new", description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path, help="file to write, such as my_env.py")
    path = parser.parse_args(arguments).path
    try:
        settings = write_example(path)
    except USER_ERRORS as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    name = path.stem
    print(f"wrote {path} and {settings}; check them, and train:")
    print(f"  python -m popl_rl.testing env {path}:Exits")
    print(f"  python -m popl_rl.testing rater {path}:up --env {path}:Exits")
    print(f"  popl-train --config-dir {path.parent} env={name}")
    return 0


def write_example(path: Path) -> Path:
    """Write the example world and its settings.

    Args:
        path: The Python file to write.

    Returns:
        The file of the settings.

    Raises:
        ValueError: If the name does not do for a Python file.
        FileExistsError: If one of the files exists.
    """
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise ValueError(f"the path must be a Python file such as my_env.py, got {path}")
    settings = path.parent / "env" / f"{path.stem}.yaml"
    for file in (path, settings):
        if file.exists():
            raise FileExistsError(f"{file} exists; choose another name")
    settings.parent.mkdir(parents=True, exist_ok=True)
    folder = files("popl_rl.envs")
    for file, example in ((path, "example.py"), (settings, "example.yaml")):
        text = (folder / example).read_text(encoding="utf-8")
        text = text.replace("my_env.py", path.as_posix()).replace("my_env", path.stem)
        write_atomic(file, text)
    return settings


def cli() -> None:
    """Console command ``popl-new``."""
    sys.exit(main())


if __name__ == "__main__":
    cli()
