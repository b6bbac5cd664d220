"""Where a run reports to while it goes on: Weights & Biases offline, or nowhere."""

import contextlib
import io
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from popl_rl.accessories import accessory

__all__ = ["RunLogger", "make_logger"]


class RunLogger:
    """Where a run reports to, besides its own folder. This one reports nowhere.

    Use it as a context manager, or call ``close``.
    """

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Report the scalars of one step together."""

    def log_figures(self, figures: Mapping[str, Figure | Path], step: int) -> None:
        """Report pictures, given as figures or as files."""

    def log_table(self, name: str, table: pd.DataFrame) -> None:
        """Report a table."""

    def close(self) -> None:
        """Finish; the logger is not used afterwards."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class _Guarded(RunLogger):
    """Reports to another logger until that fails, which is told once.

    Args:
        logger: The other logger.
        abandon: Called if it fails, so that nothing of it is left to complain at exit.
    """

    def __init__(self, logger: RunLogger, abandon: Callable[[], object]) -> None:
        self._logger = logger
        self._abandon = abandon

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        self._try(lambda logger: logger.log(metrics, step))

    def log_figures(self, figures: Mapping[str, Figure | Path], step: int) -> None:
        self._try(lambda logger: logger.log_figures(figures, step))

    def log_table(self, name: str, table: pd.DataFrame) -> None:
        self._try(lambda logger: logger.log_table(name, table))

    def close(self) -> None:
        self._try(lambda logger: logger.close())

    def _try(self, report: Callable[[RunLogger], None]) -> None:
        done = False
        with accessory(
            "Weights & Biases lacks what comes from here on",
            "metrics.csv, results.csv and the report have it all",
        ):
            report(self._logger)
            done = True
        if not done:
            self._logger = RunLogger()
            with contextlib.suppress(Exception):
                self._abandon()


class _WandbRunLogger(RunLogger):
    """Reports to an offline Weights & Biases run in the run folder, through TorchRL's logger.

    A run that is resumed has a folder of its own below ``wandb``, under the id of the first, as
    ``wandb sync <run folder>/wandb`` expects of the parts of one run.
    """

    def __init__(self, run_dir: Path, *, project: str, config: dict[str, Any]) -> None:
        # Slow to import, and not needed for logger=csv.
        import wandb
        from torchrl.record.loggers.wandb import WandbLogger

        self._wandb = wandb
        # Before TorchRL sets WANDB_MODE: the first setup in a process fixes wandb's defaults,
        # which must not become offline for other runs in this process.
        wandb.setup()
        with _restored("WANDB_MODE"):
            self._logger = WandbLogger(
                run_dir.resolve().name,
                id=_first_id(run_dir / "wandb"),
                offline=True,
                save_dir=run_dir,
                project=project,
                log_env_packages=False,
                mode="offline",
                settings=wandb.Settings(silent=True, console="off"),
            )
        self._logger.log_hparams(config)

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        self._logger.log_metrics(dict(metrics), step=step)

    def log_figures(self, figures: Mapping[str, Figure | Path], step: int) -> None:
        images: dict[str, Any] = {}
        for name, figure in figures.items():
            if isinstance(figure, Figure):
                png = io.BytesIO()
                figure.savefig(png, format="png")
                images[f"figures/{name}"] = self._wandb.Image(Image.open(png))
            elif figure.suffix == ".gif":
                images[f"figures/{name}"] = self._wandb.Video(str(figure), format="gif")
            else:
                images[f"figures/{name}"] = self._wandb.Image(str(figure))
        self._logger.experiment.log({**images, "figures/step": step})

    def log_table(self, name: str, table: pd.DataFrame) -> None:
        self._logger.experiment.log({f"tables/{name}": self._wandb.Table(dataframe=table)})

    def close(self) -> None:
        self._logger.experiment.finish()

    def abandon(self) -> None:
        """Forget the helper process, which wandb would ask for more when Python exits."""
        self._wandb.teardown()


def _first_id(folder: Path) -> str | None:
    """Id of the run that the folder holds parts of, as of a killed process; None if there is none.

    Args:
        folder: With folders ``offline-run-<time>-<id>``.
    """
    parts = sorted(folder.glob("offline-run-*-*"))
    return parts[0].name.split("-", 3)[3] if parts else None


def make_logger(
    name: Literal["wandb", "csv"], run_dir: Path, *, project: str, config: dict[str, Any]
) -> RunLogger:
    """Make the logger that a run reports to besides its own files.

    Args:
        name: ``"wandb"`` for an offline Weights & Biases run under ``run_dir/wandb``, which needs
            neither network nor account and is sent later with ``wandb sync``; ``"csv"`` for
            nothing but the run's own ``metrics.csv``.
        run_dir: Folder of the run.
        project: Project the run belongs to.
        config: Resolved configuration, as plain values.

    Returns:
        The logger; that of ``"csv"``, with one warning, if Weights & Biases does not start.

    Raises:
        ValueError: If ``name`` is unknown.
    """
    if name == "csv":
        return RunLogger()
    if name != "wandb":
        raise ValueError(f"logger must be 'wandb' or 'csv', got {name!r}")
    try:
        logger = _WandbRunLogger(run_dir, project=project, config=config)
        return _Guarded(logger, logger.abandon)
    except ImportError as error:
        cure = "install it with 'pip install wandb'"
        reason: Exception = error
    except Exception as error:  # whatever goes wrong there, a run does not depend on it
        cure = "see the logs in its wandb folder"
        reason = error
    warnings.warn(
        f"logging to metrics.csv only, Weights & Biases did not start ({reason}); {cure}, or "
        "choose logger=csv",
        stacklevel=2,
    )
    return RunLogger()


@contextmanager
def _restored(variable: str) -> Iterator[None]:
    before = os.environ.get(variable)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(variable, None)
        else:
            os.environ[variable] = before
