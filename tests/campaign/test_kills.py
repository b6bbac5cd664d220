"""Processes that are killed, disks that are full, and several processes at one folder."""

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from tensordict import TensorDict

from popl_rl.manifest import digest_of_tensors
from popl_rl.models.policy_set import PolicySet

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(3000)]

KILLS, FLIPS, SIZES, ROUNDS = 120, 40, 20, 12
MORE = ["method.generations=6", "checkpoint_interval=1", "evaluation.history=1"]


@pytest.fixture
def settings(tiny_settings):
    return [*tiny_settings, *MORE]


def results(run):
    """What a run leaves, to the bit."""
    files = [(run / name).read_bytes() for name in ("metrics.csv", "history.csv", "results.csv")]
    sets = [PolicySet.load(run / name) for name in ("policies", "baselines")]
    return files, [digest_of_tensors(one.population.members.data) for one in sets]


def assert_fine(code, text):
    assert code == 0, text
    assert "Traceback" not in text


@pytest.fixture
def whole(child, settings, tmp_path):
    """What comes out if nothing happens, and how long that takes."""
    started = time.monotonic()
    assert_fine(*child(*settings, f"run_dir={tmp_path / 'whole'}"))
    return results(tmp_path / "whole"), time.monotonic() - started


def dying_at(count):
    """Be killed at the n-th operation on files, most of which save something."""

    def before():
        left = [count]

        def dying(original):
            def call(*arguments, **options):
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                return original(*arguments, **options)

            return call

        for owner, name in [
            (Path, "rename"),
            (Path, "replace"),
            (Path, "unlink"),
            (os, "fsync"),
            (os, "rename"),
            (os, "replace"),
            (os, "posix_fallocate"),
            (shutil, "rmtree"),
            (TensorDict, "memmap"),
        ]:
            setattr(owner, name, dying(getattr(owner, name)))

    return before


def finish(child, settings, run):
    """Go on with what a killed process has left, or begin if it has left no run."""
    if (run / "config.yaml").exists():
        return child(f"resume={run}")
    return child(*settings, f"run_dir={run}")


def test_kills_at_random_moments(child, settings, whole, tmp_path, part):
    expected, seconds = whole
    draw, killed, lost = random.Random(2), 0, []
    wanted = len(part(list(range(KILLS))))
    number = 0
    while killed < wanted:
        run = tmp_path / f"run-{number}"
        number += 1
        for _ in range(4):
            command = [f"resume={run}"]
            if not (run / "config.yaml").exists():
                command = [*settings, f"run_dir={run}"]
            if draw.random() < 0.5:
                code, text = child(*command, before=dying_at(1 + draw.randrange(120)))
            else:
                code, text = child(*command, after=draw.random() * seconds)
            killed += code == -signal.SIGKILL
            assert code in (0, -signal.SIGKILL), text
        assert_fine(*finish(child, settings, run))
        if results(run) != expected:
            lost.append(run.name)
        shutil.rmtree(run)
    assert lost == []


def test_damaged_checkpoints(child, settings, whole, tmp_path, part):
    """Gone on from an earlier one, to the same bits, or refused."""
    expected, _ = whole
    draw, wrong, again = random.Random(5), [], tmp_path / "again"
    for case in part(list(range(FLIPS))):
        shutil.copytree(tmp_path / "whole", again)
        for done in ("policies", "baselines"):
            shutil.rmtree(again / done)
        for path in sorted((again / "checkpoint").iterdir())[-1 - case % 2 :]:
            content = bytearray(path.read_bytes())
            if case % 5 == 4:
                del content[draw.randrange(len(content)) :]
            else:
                content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
            path.write_bytes(content)
        code, text = child(f"resume={again}")
        if "Traceback" in text or code not in (0, 2):
            wrong.append((case, code, text[-600:]))
        if code == 2 and "no checkpoint in" not in text:
            wrong.append((case, text[-600:]))
        if code == 0 and results(again) != expected:
            wrong.append((case, "other results"))
        shutil.rmtree(again)
    assert wrong == []


def limited(size):
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@pytest.fixture
def small_disk(tmp_path):
    """A disk of its own of some size in bytes; None where nobody may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    options = ["-o", "size=4096", "tmpfs", str(folder)]
    mounted = subprocess.run(["mount", "-t", "tmpfs", *options], check=False, capture_output=True)

    def resized(size):
        again = ["mount", "-o", f"remount,size={size}", str(folder)]
        subprocess.run(again, check=True, capture_output=True)
        return folder

    yield resized if mounted.returncode == 0 else None
    if mounted.returncode == 0:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_full_disks(child, settings, whole, small_disk, tmp_path, part):
    """Told in words, with nothing lost: the run goes on to the same bits where there is room."""
    expected, _ = whole
    draw, wrong = random.Random(3), []
    for case in part(list(range(SIZES))):
        limit = draw.choice([lambda: 0.5, lambda: 1.0])() * (1 << draw.randrange(10, 21))
        run, before = tmp_path / "limited", limited(int(limit))
        if small_disk is not None and case % 2:
            run, before = small_disk(int(8 * limit)) / "run", lambda: None
        command = [*settings, f"run_dir={run}", f"data.memmap={run.parent / 'mm'}"]
        code, text = child(*command, before=before)
        said = code == 0 or (code == 2 and "could not write" in text and "are free there" in text)
        if not said or "Traceback" in text:
            wrong.append((case, limit, code, text[-600:]))
        if small_disk is not None and case % 2:
            small_disk(1 << 27)
        code, text = finish(child, command[:-2], run)
        if code != 0 or results(run) != expected:
            wrong.append((case, limit, "afterwards", code, text[-600:]))
        for folder in run.parent.glob(run.name + "*"):
            shutil.rmtree(folder)
        shutil.rmtree(run.parent / "mm", ignore_errors=True)
    assert wrong == []


def test_several_processes_at_one_folder(child, settings, whole, tmp_path, part):
    """One works; the others are told who does, at once; no result is mixed."""
    expected, seconds = whole
    draw = random.Random(4)
    for case in part(list(range(ROUNDS))):
        run = tmp_path / f"run-{case}"
        command = [*settings, f"run_dir={run}", f"data.store={tmp_path / 'store'}"]
        if case % 2:
            child(*command, after=seconds * (0.3 + draw.random() / 2))
            if (run / "config.yaml").exists():
                command = [f"resume={run}"]
        started = [child.start(*command) for _ in range(2 + case % 3)]
        ended = [child.wait(*one) for one in started]
        for code, text in ended:
            refused = "is in use by" in text or "exists and is not empty" in text
            assert code == 0 or (code == 2 and refused), text
            assert "Traceback" not in text
        assert any(code == 0 for code, _ in ended)
        assert results(run) == expected
