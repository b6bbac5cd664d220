"""Segments to compare: several behaviours, each continuing from the same state of the simulator.

Of two clips that begin alike, what differs is what was done; of two from anywhere, mostly how far
the episode had come.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from popl_rl.envs._metaworld_scripts import Scripted
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.processes import Workers

__all__ = ["FILM_STEPS", "Continued", "check_scripted", "collect_continuations"]


#: Steps between two pictures of a film.
FILM_STEPS = 4


class Continued(Protocol):
    """An environment that can be put back into a state: a Metaworld task.

    Attributes:
        task: Its name.
        max_steps: Steps after which an episode is truncated.
    """

    task: str
    max_steps: int

    def behaviours(self) -> dict[str, Scripted]:
        """Return the scripted behaviours, by name ``scripted/...`` or ``rough/...``."""
        ...

    def reset(self, *, seed: int | None = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; return its observation ``[O]`` and info."""
        ...

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take an action ``[A]``."""
        ...

    def render(self) -> Any:
        """Return the present picture."""
        ...

    def get_state(self) -> Any:
        """Return all that the episode goes on from."""
        ...

    def set_state(self, state: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Go on from a state, to the bit; return its observation ``[O]`` and info."""
        ...


def collect_continuations(
    env: Continued,
    *,
    starts: int,
    per_start: int = 4,
    length: int = 64,
    starts_per_episode: int = 6,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
    films: Callable[[int], bool] | None = None,
    keep: Callable[[int, TensorDict, list[Any]], None] | None = None,
    workers: Workers | None = None,
) -> TensorDict:
    """Collect segments of which ``per_start`` at a time begin in one state.

    Episodes of the environment's rough behaviours are run until the task is done. Where they begin,
    and states drawn uniformly from them, is where its scripted behaviours, each of a different
    speed, go on from.

    Args:
        env: Environment to collect in.
        starts: States to begin from.
        per_start: Segments from each, at most as many as there are scripted behaviours.
        length: Steps T of a segment. One that does the task sooner goes on to the end.
        starts_per_episode: States taken from one episode.
        generator: Source of seeds, of choices and of the behaviours' randomness.
        progress: Called with the number of segments collected so far.
        films: Whether to draw the segment of a number; none of them if None.
        keep: Called with number, steps and pictures of each segment that is drawn.
        workers: Processes that collect side by side, with the same result; this one if None. They
            draw no films.

    Returns:
        TensorDict ``[starts * per_start, T]``; segments of one start follow each other, and
        ``("info", "start")`` numbers the starts.

    Raises:
        ValueError: If a count is not positive or ``per_start`` exceeds the behaviours.
    """
    behaviours = env.behaviours()
    styles = [one for one in behaviours.items() if one[0].startswith("scripted/")]
    leads = [what for name, what in behaviours.items() if name.startswith("rough/")]
    if not 1 <= per_start <= len(styles):
        raise ValueError(f"per_start must be 1 to {len(styles)}, got {per_start}.")
    counts = {"starts": starts, "length": length, "starts_per_episode": starts_per_episode}
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}.")
    go_on: _Here | _Elsewhere = _Here(env, length, generator, progress, films, keep)
    if workers is not None and films is None:
        go_on = _Elsewhere(env, length, generator, progress, workers)
    start = 0
    while start < starts:
        seed = int(torch.randint(2**31, (), generator=generator))
        lead = leads[int(torch.randint(len(leads), (), generator=generator))]
        visited, _ = _episode(env, lead, seed, generator)
        # Always the reset: a policy acts from there every time, and few states look like it.
        later = 1 + torch.randperm(len(visited) - 1, generator=generator)
        chosen = torch.cat([torch.zeros(1, dtype=torch.long), later])[:starts_per_episode]
        for index in chosen[: starts - start].tolist():
            order = torch.randperm(len(styles), generator=generator)[:per_start]
            go_on(visited[index], [styles[style] for style in order.tolist()])
            start += 1
    collected: TensorDict = torch.stack(go_on.segments())  # type: ignore[call-overload]
    number = torch.arange(starts).repeat_interleave(per_start)
    collected[INFO, "start"] = number.unsqueeze(1).expand(-1, length).clone()
    return collected


class _Here:
    """Goes on from states in this process."""

    def __init__(
        self,
        env: Continued,
        length: int,
        generator: torch.Generator,
        progress: Callable[[int], None] | None,
        films: Callable[[int], bool] | None,
        keep: Callable[[int, TensorDict, list[Any]], None] | None,
    ) -> None:
        self.env, self.length, self.generator = env, length, generator
        self.progress, self.films, self.keep = progress, films, keep
        self._found: list[TensorDict] = []

    def __call__(self, state: Any, styles: Sequence[tuple[str, Scripted]]) -> None:
        """Go on from a state in each of some styles."""
        for _, style in styles:
            number = len(self._found)
            film: list[Any] | None = [] if self.films is not None and self.films(number) else None
            steps = _continue(self.env, state, style, self.length, self.generator, film)
            if self.keep is not None and film is not None:
                self.keep(number, steps, film)
            self._found.append(steps)
        if self.progress is not None:
            self.progress(len(self._found))

    def segments(self) -> list[TensorDict]:
        """What was collected."""
        return self._found


class _Elsewhere:
    """Has workers go on from states, each state's segments in one of them.

    How much randomness a segment takes is known before it is collected, so that the generator goes
    through the same states as if it were collected here.
    """

    def __init__(
        self,
        env: Continued,
        length: int,
        generator: torch.Generator,
        progress: Callable[[int], None] | None,
        workers: Workers,
    ) -> None:
        self.env, self.length, self.generator = env, length, generator
        self.progress, self.workers = progress, workers
        self._asked: list[Future[list[dict[str, Any]]]] = []

    def __call__(self, state: Any, styles: Sequence[tuple[str, Scripted]]) -> None:
        """Ask for segments from a state in each of some styles."""
        begins = []
        for name, style in styles:
            begins.append((name, self.generator.get_state().numpy()))
            style.skip(self.length, self.generator)
        worker = len(self._asked) % len(self.workers)
        asked = self.workers.submit(worker, _continue_each, self.env, state, begins, self.length)
        self._asked.append(asked)

    def segments(self) -> list[TensorDict]:
        """What was collected, once all of it is."""
        found: list[TensorDict] = []
        for asked in self._asked:
            found += [TensorDict(steps, [self.length]) for steps in asked.result()]
            if self.progress is not None:
                self.progress(len(found))
        return found


def _continue_each(
    env: Continued, state: Any, begins: Sequence[tuple[str, NDArray[np.uint8]]], length: int
) -> list[dict[str, Any]]:
    """Segments of a worker, as arrays: tensors would each hold a file open until they are read."""
    env.reset(seed=0)  # from then on the simulator's attributes are those of any episode
    behaviours, generator = env.behaviours(), torch.Generator()
    found = []
    for name, begin in begins:
        generator.set_state(torch.from_numpy(begin))
        found.append(_continue(env, state, behaviours[name], length, generator).numpy())
    return found


def check_scripted(
    env: Continued, *, episodes: int = 10, least: float = 0.5, seed: int = 0
) -> dict[str, float]:
    """Measure how often the environment's behaviours do the task, and refuse if they rarely do.

    Args:
        env: Environment to try them in.
        episodes: Episodes of each behaviour.
        least: Share of successes that each scripted behaviour must reach.
        seed: Seed of starts and noise.

    Returns:
        Share of successes within ``env.max_steps`` by scripted behaviour; rough ones may fail.

    Raises:
        ValueError: If ``episodes`` is not positive or a scripted behaviour fails too often.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}.")
    generator = torch.Generator().manual_seed(seed)
    rates = {}
    for name, behaviour in env.behaviours().items():
        if not name.startswith("scripted/"):
            continue
        ends = [_episode(env, behaviour, seed + e, generator)[1] for e in range(episodes)]
        rates[name] = sum(ends) / episodes
    poor = {name: rate for name, rate in rates.items() if rate < least}
    if poor:
        said = ", ".join(f"{name} {rate:.0%}" for name, rate in poor.items())
        raise ValueError(
            f"task {env.task!r}: the scripted policy succeeds too rarely to learn from within "
            f"{env.max_steps} steps ({said} of {episodes} episodes, at least {least:.0%} wanted); "
            "raise env.max_steps, leave out speeds at which it fails "
            "(env.options.speeds=[0.6,0.8]), or choose another task."
        )
    return rates


def _episode(
    env: Continued, behaviour: Scripted, seed: int, generator: torch.Generator
) -> tuple[list[Any], bool]:
    """Return every fourth state of an episode until the task is done, and whether it was."""
    behaviour.reset()
    observation, _ = env.reset(seed=seed)
    states = []
    for time in range(env.max_steps):
        if time % 4 == 0:
            states.append(env.get_state())
        action = behaviour.act(observation[None], generator)[0]
        observation, _, _, _, info = env.step(action.numpy())
        if info["success"]:
            return states, True
    return states, False


def _continue(
    env: Continued,
    state: Any,
    behaviour: Scripted,
    length: int,
    generator: torch.Generator,
    film: list[Any] | None = None,
) -> TensorDict:
    """Go on from a state; of a film, the pictures before every fourth step and after the last."""
    behaviour.reset()
    observation, _ = env.set_state(state)
    seen, done, rewards = [], [], []
    infos: list[Mapping[str, Any]] = []
    for time in range(length):
        if film is not None and time % FILM_STEPS == 0:
            film.append(env.render())
        action = behaviour.act(observation[None], generator)[0]
        seen.append(observation)
        done.append(action)
        observation, reward, _, _, info = env.step(action.numpy())
        rewards.append(reward)
        infos.append(info)
    if film is not None:
        film.append(env.render())
    columns = {name: torch.from_numpy(np.stack([i[name] for i in infos])) for name in infos[0]}
    return TensorDict(
        {
            OBSERVATION: torch.from_numpy(np.stack(seen)),
            ACTION: torch.stack(done),
            REWARD: torch.tensor(rewards, dtype=torch.float32),
            INFO: columns,
        },
        [length],
    )
