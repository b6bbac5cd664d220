"""MethodTrainer with a stand-in for POPL that has the same kinds of state.

Run as a script with a folder, this file trains there while being killed again and again.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.checkpoint import Checkpoint

from popl_rl.algorithms.trainer import MethodTrainer
from popl_rl.experiments.metrics import MetricsWriter

GENERATIONS = 40
#: Runs a script without looking for garbage in what it imports.
UNCOLLECTED = """
import gc, runpy, sys
gc.disable()
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


class FakePOPL:
    """Random gradient steps: a tensor, a generator and Adam's nested state."""

    def __init__(self, seed: int = 0, members: int = 3) -> None:
        self.generation = 0
        self.generator = torch.Generator().manual_seed(seed)
        self.weight = torch.nn.Parameter(torch.randn(members, 4, generator=self.generator))
        self.bias = torch.nn.Parameter(torch.zeros(members))
        self.optimizer = torch.optim.Adam([self.weight, self.bias], lr=0.1)

    def step(self) -> dict[str, float]:
        target = torch.randn(self.weight.shape, generator=self.generator)
        loss = (self.weight - target).square().sum() + (self.bias - target[:, 0]).square().sum()
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.generation += 1
        return {"loss_cpl": loss.item(), "distinct": float(self.generation % 3)}

    def state_dict(self) -> dict[str, Any]:
        return {
            "generation": self.generation,
            "members": {"0": {"weight": self.weight.detach(), "bias": self.bias.detach()}},
            "variation": {"optimizer": self.optimizer.state_dict(), "name": "fake", "none": {}},
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.generation = state["generation"]
        self.weight.data.copy_(state["members"]["0"]["weight"])
        self.bias.data.copy_(state["members"]["0"]["bias"])
        self.optimizer.load_state_dict(state["variation"]["optimizer"])
        self.generator.set_state(state["generator"])


Log = list[tuple[int, dict[str, float]]]


def make(
    folder: Path, popl: FakePOPL, log: Log, *, generations: int = 10, interval: int = 3
) -> MethodTrainer:
    return MethodTrainer(
        popl,
        generations=generations,
        checkpoint_dir=folder,
        checkpoint_interval=interval,
        on_generation=lambda generation, metrics: log.append((generation, metrics)),
    )


def leaves(state: Any, path: str = "") -> dict[str, Any]:
    if isinstance(state, dict):
        items = [(f"{path}/{key!r}", value) for key, value in state.items()]
    elif isinstance(state, list | tuple):
        items = [(f"{path}/{type(state).__name__}{i}", value) for i, value in enumerate(state)]
    else:
        return {path: state}
    return {key: leaf for name, value in items for key, leaf in leaves(value, name).items()}


def assert_same_state(first: FakePOPL, second: FakePOPL) -> None:
    one, two = leaves(first.state_dict()), leaves(second.state_dict())
    assert one.keys() == two.keys()
    for name, value in one.items():
        same = torch.equal(value, two[name]) if isinstance(value, Tensor) else value == two[name]
        assert same, name


def names(folder: Path) -> list[int]:
    return sorted(int(path.stem.removeprefix("checkpoint-")) for path in folder.iterdir())


def test_every_generation_is_reported_once_and_in_order(tmp_path: Path) -> None:
    popl, plain = FakePOPL(), FakePOPL()
    log: Log = []
    make(tmp_path, popl, log).train()
    assert log == [(generation, plain.step()) for generation in range(1, 11)]
    assert_same_state(popl, plain)


def test_checkpoints_are_written_at_the_interval_and_at_the_end_and_two_are_kept(
    tmp_path: Path,
) -> None:
    seen: list[list[int]] = []
    trainer = MethodTrainer(
        FakePOPL(),
        generations=10,
        checkpoint_dir=tmp_path,
        checkpoint_interval=3,
        on_generation=lambda *_: seen.append(names(tmp_path)),
    )
    trainer.train()
    # Seen before the checkpoint of the same generation is written.
    assert seen == [[], [], [], [3], [3], [3], [3, 6], [3, 6], [3, 6], [6, 9]]
    assert names(tmp_path) == [9, 10]


@pytest.mark.parametrize("stop", [1, 4, 9])
def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(tmp_path: Path, stop: int) -> None:
    whole, first, second = FakePOPL(), FakePOPL(), FakePOPL(seed=1)
    log: Log = []
    parts: Log = []
    make(tmp_path / "whole", whole, log).train()
    make(tmp_path / "parts", first, parts, generations=stop).train()
    trainer = make(tmp_path / "parts", second, parts)
    assert trainer.resume() == stop
    assert_same_state(first, second)
    trainer.train()
    assert parts == log
    assert_same_state(whole, second)


def test_resuming_without_checkpoints_starts_from_the_beginning(tmp_path: Path) -> None:
    log: Log = []
    trainer = make(tmp_path / "new", FakePOPL(), log)
    assert trainer.resume() == 0
    trainer.train()
    assert len(log) == 10


def test_a_finished_run_does_nothing_more(tmp_path: Path) -> None:
    popl, again = FakePOPL(), FakePOPL(seed=1)
    log: Log = []
    make(tmp_path, popl, log).train()
    trainer = make(tmp_path, again, log)
    assert trainer.resume() == 10
    trainer.train()
    assert len(log) == 10
    assert_same_state(popl, again)


def test_adam_resumes_before_its_first_step(tmp_path: Path) -> None:
    popl, again = FakePOPL(), FakePOPL(seed=1)
    trainer = make(tmp_path, popl, [])
    trainer.save_trainer(force_save=True)
    assert popl.optimizer.state_dict()["state"] == {}
    assert make(tmp_path, again, []).resume() == 0
    assert_same_state(popl, again)
    assert popl.step() == again.step()


def test_the_global_generators_resume_too(tmp_path: Path) -> None:
    make(tmp_path, FakePOPL(), [], generations=3).train()
    draws = [random.random(), torch.rand(()).item()]
    make(tmp_path, FakePOPL(), []).resume()
    assert [random.random(), torch.rand(()).item()] == draws


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "garbage"])
def test_a_damaged_checkpoint_falls_back_to_the_one_before_with_a_warning(
    tmp_path: Path, damage: str
) -> None:
    whole, popl = FakePOPL(), FakePOPL(seed=1)
    log: Log = []
    make(tmp_path, whole, log).train()
    newest = tmp_path / "checkpoint-000000000010.torchrl"
    data = bytearray(newest.read_bytes())
    if damage == "flipped":
        data[data.find(b"tensor_00000000.memmap") + 40] ^= 1
    damaged = {"cut": data[:-50], "flipped": data, "empty": b"", "garbage": b"hello"}
    newest.write_bytes(bytes(damaged[damage]))
    trainer = make(tmp_path, popl, log)
    with pytest.warns(UserWarning, match=r"earlier checkpoint checkpoint-0*9\.torchrl, because"):
        assert trainer.resume() == 9
    trainer.train()
    assert_same_state(whole, popl)
    assert log[-1] == log[-2]
    assert make(tmp_path, FakePOPL(), []).resume() == 10, "the damaged one is replaced"


def test_nothing_but_damaged_checkpoints_is_an_error(tmp_path: Path) -> None:
    make(tmp_path, FakePOPL(), []).train()
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match=r"no checkpoint in .* can be resumed .*another run_dir"):
        make(tmp_path, FakePOPL(), []).resume()


def test_a_checkpoint_of_another_configuration_is_an_error(tmp_path: Path) -> None:
    make(tmp_path, FakePOPL(members=2), []).train()
    with pytest.raises(ValueError, match=r"must match the size .*resume with that run's config"):
        make(tmp_path, FakePOPL(members=3), []).resume()


def test_a_checkpoint_of_something_else_is_an_error(tmp_path: Path) -> None:
    Checkpoint(policy=torch.nn.Linear(1, 1)).save(tmp_path / "checkpoint-000000000001")
    with pytest.raises(ValueError, match=r"missing=\['collector', 'loss_module'"):
        make(tmp_path, FakePOPL(), []).resume()


@pytest.mark.parametrize("name", ["generations", "checkpoint_interval"])
def test_numbers_must_be_positive(tmp_path: Path, name: str) -> None:
    numbers = {"generations": 1, "checkpoint_interval": 1, name: 0}
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        MethodTrainer(FakePOPL(), checkpoint_dir=tmp_path, on_generation=lambda *_: None, **numbers)


def train_in(folder: Path) -> FakePOPL:
    """As a training script does it: metrics to a file, and resuming whatever is there."""
    popl = FakePOPL()
    writer = MetricsWriter(folder / "metrics.csv")
    trainer = MethodTrainer(
        popl,
        generations=GENERATIONS,
        checkpoint_dir=folder / "checkpoint",
        checkpoint_interval=4,
        on_generation=writer.write,
    )
    writer.truncate_to(trainer.resume())
    trainer.train()
    return popl


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forked processes")
def test_a_run_that_is_killed_at_random_moments_ends_as_if_it_had_not_been(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    popl = train_in(whole)
    # In a process of its own: forking one that runs threads, as pytest may, is unsafe.
    script = [sys.executable, "-W", "error", "-c", UNCOLLECTED, __file__, str(killed)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(script, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 3, "too few kills to show anything"
    assert done.stderr == ""
    again = FakePOPL(seed=1)
    assert make(killed / "checkpoint", again, [], generations=GENERATIONS).resume() == GENERATIONS
    assert_same_state(popl, again)
    assert (killed / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    # A kill before older checkpoints are removed leaves more than two, until the next is written;
    # half-written ones, whose names are no numbers, are gone.
    assert names(killed / "checkpoint")[-2:] == [GENERATIONS - 4, GENERATIONS]


def kill_again_and_again(folder: Path, *, seconds: float) -> int:
    """Start a run that takes so many seconds until one ends; how often it was killed before."""
    delays = random.Random(0)
    kills = 0
    while True:
        child = os.fork()
        if child == 0:
            train_in(folder)
            os._exit(0)
        # A small part of the run, whatever the machine's speed, and longer and longer, so that it
        # ends where starting takes most of that.
        time.sleep(seconds * delays.uniform(0.02, 0.25) * (1 + kills / 5))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            return kills
        kills += 1


if __name__ == "__main__":
    torch.set_num_threads(1)
    spent = 0.0
    for _ in range(2):  # the first imports what is imported late, once and not per child
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            train_in(Path(folder))
            spent = time.perf_counter() - started
    sys.stdout.write(str(kill_again_and_again(Path(sys.argv[1]), seconds=spent)))
