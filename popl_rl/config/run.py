"""Settings of a whole run, and one check of it all."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Protocol

from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf

from popl_rl.config.checks import Checker, check_workers
from popl_rl.config.data import DataConfig, EnvConfig, RatersConfig
from popl_rl.config.evaluation import EvaluationConfig
from popl_rl.config.method import MethodConfig
from popl_rl.config.overrides import OPEN
from popl_rl.config.people import PeopleConfig

__all__ = ["Checked", "Config", "EvaluateConfig", "LoggerConfig", "plain", "validate"]


class Checked(Protocol):
    """Settings that know what they may be."""

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        ...


@dataclass
class LoggerConfig:
    """Where metrics go besides metrics.csv."""

    name: str = "wandb"  # wandb (offline) or csv (nothing more)
    project: str = "popl_rl"

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.expect(self.name in ("wandb", "csv"), "name", "wandb or csv", self.name)


@dataclass
class EvaluateConfig:
    """What popl-evaluate does with a finished run."""

    run_dir: str = MISSING  # folder of the run
    # What differs from the run's own settings: MISSING, which merging passes over, is as the run.
    evaluation: EvaluationConfig = field(
        default_factory=lambda: EvaluationConfig(
            **dict.fromkeys((setting.name for setting in fields(EvaluationConfig)), MISSING)
        )
    )
    # Where real people judge: curve and repeats; the rest says what was learnt and from whom.
    people: PeopleConfig = field(
        default_factory=lambda: PeopleConfig(
            **dict.fromkeys((setting.name for setting in fields(PeopleConfig)), MISSING)
        )
    )
    # Of the held-out pairs, new raters and episodes, or of which answers are told. The run's seed
    # + 1 if null, which gives other ones than the run's; the run's seed gives its own.
    seed: int | None = None
    workers: str = "1"  # processes that step environments: a number, or auto for all cores


@dataclass
class Config:
    """A whole run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    raters: RatersConfig = field(default_factory=RatersConfig)
    data: DataConfig = field(default_factory=DataConfig)
    method: MethodConfig = field(default_factory=MethodConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    people: PeopleConfig = field(default_factory=PeopleConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = 0
    device: str = "cpu"  # where policies are trained: cpu or cuda
    threads: int = 1  # torch threads; on small networks more is slower
    workers: str = "1"  # processes that step environments: a number, or auto for all cores
    run_dir: str | None = None  # folder of the run; runs/<time>-<method>-<seed> if null
    resume: str | None = None  # folder of a killed run to finish
    checkpoint_interval: int = 10  # generations between checkpoints

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        for name in ("env", "raters", "data", "method", "evaluation", "people", "logger"):
            getattr(self, name).check(at.below(name))
        from_people = bool(self.raters.groups) or self.data.load is not None
        cure = (
            "one or more rater references, such as [my_raters.py:fast,my_raters.py:careful], "
            "unless people's answers are in data.load"
        )
        at.expect(from_people, "raters.groups", cure, self.raters.groups)
        proper = re.fullmatch(r"cpu|cuda(:\d{1,3})?", self.device)
        at.expect(proper is not None, "device", "cpu, cuda, or one of them, as cuda:1", self.device)
        at.at_least_one(self, "threads", most=1024)
        check_workers(self.workers, at)
        at.at_least_one(self, "checkpoint_interval")
        at.seed(self)
        for name in ("run_dir", "resume"):
            value = getattr(self, name)
            at.expect(value is None or bool(value.strip()), name, "a folder, or null", value)
        self._check_together(at)

    def _check_together(self, at: Checker) -> None:
        """Report what is well by itself and does not go together."""
        asked, groups = self.raters.count, len(self.raters.groups)
        # Answers that are loaded have raters of their own.
        is_trained = self.evaluation.baselines and self.evaluation.baselines_from is None
        if is_trained and self.data.load is None:
            expected = (
                f"at least one for each group ({groups}), because a group that gives no strict "
                "answer has no oracle: ask more raters, or set evaluation.baselines=false"
            )
            at.expect(asked >= groups, "raters.count", expected, asked)
        if self.method.evolve == "code" or self.evaluation.reference == "clone":
            learns = self.method.learns
            at.expect(learns != "reward", "method.learns", "policy for a clone", learns)


def plain(config: Any) -> Any:
    """The dataclasses of a configuration that Hydra composed, with references resolved.

    Args:
        config: A ``DictConfig`` with a schema of this package, or such a dataclass.

    Raises:
        ValueError: If there are settings that the schema does not know, or lists within lists.
    """
    if not isinstance(config, DictConfig):
        return config
    unknown = list(_unknown(config, ""))
    if unknown:
        raise ValueError(
            f"there is no such setting as {', '.join(unknown)}; what is appended with a plus are "
            f"arguments, in {', '.join(OPEN)}"
        )
    nested = list(_nested(config, ""))
    if nested:
        raise ValueError(f"entries of lists must be no lists or mappings, got {', '.join(nested)}")
    return OmegaConf.to_object(config)


def _nested(config: DictConfig, path: str) -> Iterator[str]:
    """Lists of settings that hold lists or mappings, which no setting does."""
    if not is_dataclass(OmegaConf.get_type(config)):
        return
    for name in config:
        value = None if OmegaConf.is_missing(config, name) else config[name]
        if isinstance(value, DictConfig):
            yield from _nested(value, f"{path}{name!s}.")
        elif isinstance(value, ListConfig) and any(map(OmegaConf.is_config, value)):
            yield f"{path}{name!s}={value}"


def _unknown(config: DictConfig, path: str) -> Iterator[str]:
    """Names that Hydra has let somebody append to a section that has a schema."""
    schema = OmegaConf.get_type(config)
    if not is_dataclass(schema):
        return
    known = {field.name for field in fields(schema)}
    for name in config:
        full = f"{path}{name!s}"
        if name not in known:
            yield full
        elif not OmegaConf.is_missing(config, name):
            value = config[name]
            if isinstance(value, DictConfig):
                yield from _unknown(value, f"{full}.")


def validate(config: Checked) -> None:
    """Check values that can be checked before anything is built.

    Raises:
        ValueError: Listing every problem at once, each with what was expected and what came.
    """
    problems: list[str] = []
    plain(config).check(Checker("", problems))
    if problems:
        raise ValueError("the configuration has problems:\n  " + "\n  ".join(problems))
