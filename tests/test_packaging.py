"""The wheel: it holds the whole tree, and works where there is no checkout."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.packaging

ROOT = Path(__file__).parents[1]
# Folders of the checkout, and where they are in the wheel.
TREES = {
    "popl_rl": "popl_rl",
    "envs": "popl_rl/envs",
    "trainers": "popl_rl/trainers",
    "configs": "popl_rl/configs",
}


def execute(*command, cwd, **environment):
    done = subprocess.run(
        list(map(str, command)),
        check=False,
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=250,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    # Built from a copy, so that nothing is left behind in the checkout.
    for name in (*TREES, "pyproject.toml", "README.md", "LICENSE"):
        (source / name).symlink_to(ROOT / name)
    build = ["-m", "build", "--wheel", "--no-isolation", "--outdir", folder / "dist"]
    execute(sys.executable, *build, cwd=source)
    return next((folder / "dist").glob("*.whl"))


def test_the_wheel_holds_the_tree(wheel):
    kinds = {".py", ".yaml", ".typed", ".html", ".css", ".js", ".json"}
    expected = {
        f"{inside}/{path.relative_to(ROOT / folder).as_posix()}": path.read_bytes()
        for folder, inside in TREES.items()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in kinds or path.name == "py.typed"
    }
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        found = {name: archive.read(name) for name in names}
    assert set(found) == set(expected)
    assert found == expected


def test_the_wheel_holds_the_licence(wheel):
    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist() if name.endswith("/licenses/LICENSE")]
        assert archive.read(name) == (ROOT / "LICENSE").read_bytes()


def test_the_wheel_works_elsewhere(wheel, tmp_path, tiny):
    target = tmp_path / "venv"
    execute(sys.executable, "-m", "venv", "--without-pip", target, cwd=tmp_path)
    python = target / "bin" / "python"
    site = Path(next(target.glob("lib/python*/site-packages")))
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index"]
    execute(*pip, wheel, cwd=tmp_path)
    # Dependencies come from this environment; a path file of its own, such as that of an editable
    # install of the checkout, is not followed from here.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    work = tmp_path / "work"
    work.mkdir()
    where = execute(python, "-c", "import popl_rl; print(popl_rl.__file__)", cwd=work)
    assert Path(where.strip()).is_relative_to(target)
    execute(target / "bin" / "popl-train", *tiny, "run_dir=run", cwd=work)
    assert (work / "run" / "report.md").is_file()
    help_text = execute(target / "bin" / "popl-evaluate", "--help", cwd=work)
    assert "evaluate" in help_text
