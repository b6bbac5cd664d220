import re
import shlex
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
CONFIGS = {"popl-train": "train", "popl-evaluate": "evaluate", "popl-benchmark": "benchmark"}
PROMPT = re.compile(r"^\s*\$ ")


def blocks(language):
    return re.findall(rf"^```{language}[^\n]*\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands():
    lines = [
        PROMPT.sub("", line)
        for block in blocks("bash")
        for line in block.replace("\\\n", " ").splitlines()
    ]
    return [line.strip() for line in lines if line.strip().startswith(tuple(CONFIGS))]


def test_the_readme_has_examples():
    assert blocks("python"), "README.md must show the library in a ```python block"
    assert commands(), "README.md must show popl-train in a ```bash block"


@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_run(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})


@pytest.mark.parametrize("command", commands())
def test_commands_name_options_that_exist(command, config_of):
    program, *arguments = shlex.split(command, comments=True)
    # A sweep's comma-separated values are Hydra's business; each one alone must fit.
    sweep = "-m" in arguments or "--multirun" in arguments
    overrides = [argument for argument in arguments if not argument.startswith("-")]
    # Launchers are plug-ins that need not be installed.
    overrides = [o for o in overrides if not o.startswith(("hydra/launcher=", "hydra.launcher."))]
    if sweep:
        overrides = [first_value(override) for override in overrides]
    config_of(*overrides, name=CONFIGS[program])


def first_value(override):
    name, _, value = override.partition("=")
    if value.startswith("range("):
        value = value.removeprefix("range(")
    return override if value.startswith(("[", "{", "'", '"')) else f"{name}={value.split(',')[0]}"
