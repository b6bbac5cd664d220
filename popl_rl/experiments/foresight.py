"""How long a run will take, told as soon as a generation has been timed."""

import sys
import time

from popl_rl.algorithms.problem import Method
from popl_rl.config import Config, MethodConfig
from popl_rl.experiments.progress import in_words, is_told

__all__ = ["Foresight", "last_training"]

#: A step of few networks takes at least this share of the time of a step of all members, because
#: much of a step's time does not depend on their number.
_LEAST = 0.25
_LONG = 30.0  # seconds of a first generation after which one does not wait for the second


def last_training(config: MethodConfig, method: Method) -> int | None:
    """Steps of the last training after all generations; None if a method has none."""
    return config.refinement.steps if getattr(method, "refinement", None) is not None else None


class Foresight:
    """Says on stderr what is still to come, and how long it will take, after the first generations.

    The time of a step of gradient descent is taken from the last one, so that it is an estimate.
    The evaluation's time is not foreseen.

    Args:
        config: Settings of the run.
        method: What is trained.
        groups: Number of groups, each of which has an oracle.
    """

    def __init__(self, config: Config, method: Method, *, groups: int) -> None:
        self.config, self.method, self.groups = config, method, groups
        self.began = time.monotonic()
        self.timed = 0
        self.was_told = False

    def __call__(self, generation: int) -> None:
        """Call when a generation is done."""
        self.timed += 1
        now = time.monotonic()
        seconds, self.began = now - self.began, now
        # The first one also loads what is needed for the first time: it is asked if it is long.
        if self.was_told or not is_told() or (self.timed == 1 and seconds < _LONG):
            return
        self.was_told = True
        total, parts = self.ahead(generation, seconds)
        sys.stderr.write(f"{in_words(total)} ahead: {', '.join(parts)}; then the evaluation\n")
        sys.stderr.flush()

    def ahead(self, generation: int, seconds: float) -> tuple[float, list[str]]:
        """Seconds that are ahead, and what they are for.

        Args:
            generation: Generations done.
            seconds: What the last one took.
        """
        method = self.config.method
        left = max(self.method.generations - generation, 0)
        per_step = seconds * self.method.generations / method.training.steps
        total, parts = left * seconds, [f"{left} generation{'s' * (left != 1)}"]
        steps = last_training(method, self.method)
        if steps is not None:
            most = (method.refinement.folds + 1) * method.refinement.most
            total += steps * per_step * self._share(most)
            parts.append("one last training")
        if self.config.evaluation.baselines and self.config.evaluation.baselines_from is None:
            total += method.training.steps * per_step * self._share(1 + self.groups)
            parts.append(f"pooled CPL and {self.groups} oracles")
        return total, parts

    def _share(self, networks: int) -> float:
        """Time of a step of some networks, in steps of all members."""
        members = max(len(self.method.population), 1)
        return _LEAST + (1 - _LEAST) * networks / members
