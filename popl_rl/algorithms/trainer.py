"""POPL as a TorchRL Trainer: generations, checkpoints, and resuming to the bit.

A frame of the Trainer is a generation: its collector yields one empty batch for each, and its
optimisation step is ``popl_rl.algorithms.popl.POPL.step``. What that buys over a loop of five lines
is TorchRL's hooks (``register_op``, ``EarlyStopping``, ``request_stop``) and its registration of
everything that has a state in one checkpoint.
"""

import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

from popl_rl.algorithms.problem import Method
from popl_rl.interruption import Terminated, is_asked_to_end, putting_off
from popl_rl.storage import explaining_full_disk, reserve

with warnings.catch_warnings():
    # TorchRL 0.14 deprecates a base class that it still derives from, and says so when imported.
    warnings.simplefilter("ignore", DeprecationWarning)
    from torchrl.trainers import OptimizationStepper, Trainer

__all__ = ["MethodTrainer"]

_MARGIN = 1 << 20  # bytes of a checkpoint besides its tensors: JSON, names, the state of the loop


class MethodTrainer(Trainer):
    """Runs a POPL to a number of generations and keeps its last two checkpoints.

    A checkpoint is written every ``checkpoint_interval`` generations and after the last one, after
    ``on_generation`` has returned: what that function wrote is never behind the checkpoint.

    Args:
        method: What to train; changed in place.
        generations: Generation to stop at, counted from the first of the run.
        checkpoint_dir: Folder of the checkpoints; created with the first one.
        checkpoint_interval: Generations between two checkpoints.
        on_generation: Called with the number of generations done and the scalars of the last one.
        run: Id of the run, which checkpoints keep: those of another run are not resumed from.

    Raises:
        ValueError: If ``generations`` or ``checkpoint_interval`` is not positive.

    Example:
        >>> trainer = MethodTrainer(  # doctest: +SKIP
        ...     method, generations=60, checkpoint_dir=run / "checkpoint", checkpoint_interval=5,
        ...     on_generation=lambda generation, metrics: writer.write(generation, metrics),
        ... )
        >>> trainer.resume()  # doctest: +SKIP
        0
        >>> trainer.train()  # doctest: +SKIP
    """

    def __init__(
        self,
        method: Method,
        *,
        generations: int,
        checkpoint_dir: Path,
        checkpoint_interval: int,
        on_generation: Callable[[int, dict[str, float]], None],
        run: str | None = None,
    ) -> None:
        for name, value in [
            ("generations", generations),
            ("checkpoint_interval", checkpoint_interval),
        ]:
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        super().__init__(
            collector=_Generations(method, generations, run),
            total_frames=generations,
            frame_skip=1,
            optim_steps_per_batch=1,
            # Never called, as the stepper takes its place, but saved under this name.
            loss_module=method,
            optimization_stepper=_Step(method, on_generation),
            progress_bar=False,
            # An archive carries a CRC of every file: TorchRL's directory format would fill a
            # truncated tensor file with zeros and load it.
            checkpoint=Checkpoint(rng=GlobalRNGState(), format="archive"),
            checkpoint_rotation=CheckpointRotation(checkpoint_dir, keep_last=2),
            # The Trainer saves once more than this many frames have passed.
            save_trainer_interval=checkpoint_interval - 1,
        )
        self.method = method
        self.collected_frames = method.generation

    def train(self) -> None:
        """Run the generations that are left.

        Raises:
            Terminated: After SIGTERM, once the generation at hand is done and its checkpoint
                written.
            OSError: If there is no room for a checkpoint; the earlier ones are kept.
        """
        with putting_off():
            super().train()
        if is_asked_to_end():
            raise Terminated

    def _save_trainer(self) -> None:
        """Write a checkpoint, if there is room: a memory map that fails ends the process."""
        directory = self.checkpoint_rotation.directory
        directory.mkdir(parents=True, exist_ok=True)
        # Tensors are written once by themselves and once more into the archive.
        need = 2 * _bytes_in(self.method.state_dict()) + _MARGIN
        with explaining_full_disk(directory / "checkpoint", need=need):
            reserve(directory, need)
            super()._save_trainer()

    def resume(self) -> int:
        """Continue from the newest checkpoint that can be read.

        Returns:
            Generations done: 0 or what ``popl`` already had if there is no checkpoint. Rows that
            were logged after this generation will be logged again.

        Raises:
            ValueError: If there are checkpoints and none of them can be read into this ``popl``.
        """
        directory = self.checkpoint_rotation.directory
        _remove_unfinished(directory)
        found = sorted(directory.glob("checkpoint-*"), reverse=True)
        problems = []
        for path in found:
            try:
                self._restore(path)
            except Exception as error:  # a damaged archive makes zipfile and json raise many kinds
                problems.append(f"{path.name}: {error}")
                continue
            if problems:
                warnings.warn(
                    f"resumed from the earlier checkpoint {path.name}, because "
                    f"{'; '.join(problems)}",
                    stacklevel=2,
                )
            return self.method.generation
        if found:
            raise ValueError(
                f"no checkpoint in {directory} can be resumed ({'; '.join(problems)}); they are "
                "damaged or of a run with another configuration: resume with that run's config, "
                "or start again in another run_dir"
            )
        return self.method.generation

    def _restore(self, path: Path) -> None:
        if not Checkpoint.is_checkpoint(path):
            raise CheckpointError("not a checkpoint, or cut off")
        self.load_from_file(path)


class _Step(OptimizationStepper):
    """One generation in the place of an optimisation step."""

    def __init__(
        self, method: Method, on_generation: Callable[[int, dict[str, float]], None]
    ) -> None:
        self.method = method
        self.on_generation = on_generation

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        metrics = self.method.step()
        self.on_generation(self.method.generation, metrics)
        if is_asked_to_end():
            trainer.request_stop("SIGTERM")
        return TensorDict(metrics)


class _Generations:
    """The collector that the Trainer asks for: one empty batch for each generation to do."""

    init_random_frames = 0

    def __init__(self, method: Method, generations: int, run: str | None) -> None:
        self.method = method
        self.generations = generations
        self.run = run

    def __iter__(self) -> Iterator[TensorDict]:
        for _ in range(self.method.generation, self.generations):
            yield TensorDict(batch_size=[1])

    def shutdown(self) -> None:
        """Nothing runs in the background."""

    def state_dict(self) -> dict[str, Any]:
        return {"run": self.run or ""}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The method knows how far it is; whose it is must be compared."""
        if state.get("run", "") != (self.run or ""):
            raise CheckpointError(
                f"it is of run {state.get('run') or 'unknown'}, not of {self.run or 'unknown'}"
            )


def _bytes_in(state: Any) -> int:
    """Bytes of all tensors in a nested state."""
    if isinstance(state, Tensor):
        return state.numel() * state.element_size()
    if isinstance(state, Mapping | TensorDictBase):
        return sum(_bytes_in(value) for value in state.values())
    return sum(map(_bytes_in, state)) if isinstance(state, list | tuple) else 0


def _remove_unfinished(directory: Path) -> None:
    # Left by a process that was killed while TorchRL wrote or removed a checkpoint.
    for path in directory.glob(".checkpoint-*"):
        if re.search(r"\.(stage|archive|backup|delete)-[0-9a-f]{32}$", path.name):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
