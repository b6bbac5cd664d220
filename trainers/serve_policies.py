"""Let people find their own policy in a few questions: ``popl-serve``.

popl-serve run_dir=runs/mine
popl-serve run_dir=runs/mine serve.questions=8 page.port=8001

A person compares at most five pairs, those whose answers tell most, and is shown the policy that
suits. The run's folder gets ``served/`` with the answers and clips.
"""

import secrets
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import hydra
from omegaconf import OmegaConf

from popl_rl.config import Config, ServeConfig, plain, validate
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.trainers.command import register_schemas, run_command

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from tensordict import TensorDictBase

    from popl_rl.data.environments import World
    from popl_rl.models.hypothesis_set import HypothesisSet
    from popl_rl.web.catering import Caterer
    from popl_rl.web.clips import Clips
    from popl_rl.web.numbers import Number
    from popl_rl.web.server import Address


@dataclass(frozen=True)
class Serving:
    """A page that is ready to run.

    Attributes:
        app: The application.
        caterer: Questions, answers and what was served.
        address: Where it listens.
        key: Word that visitors need; None for none.
        word: Word that opens the researcher's page.
    """

    app: "Starlette"
    caterer: "Caterer"
    address: "Address"
    key: str | None
    word: str


def prepare(config: ServeConfig) -> Serving:
    """Everything up to the first visitor: the set, candidates, clips, numbers, page.

    Raises:
        ValueError: If settings are off, or the run kept no data.
        FileNotFoundError: If there is no finished run.
    """
    config = plain(config)
    validate(config)
    run_dir = Path(config.run_dir)
    stored: Config = plain(OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run_dir)))
    from popl_rl.web.extra import require_extra

    require_extra()
    import torch

    from popl_rl.experiments.data import build_world
    from popl_rl.web.guards import guards, hosts_of
    from popl_rl.web.pages import Pages
    from popl_rl.web.serve_app import ServePages
    from popl_rl.web.server import listen

    torch.set_num_threads(1)
    world = build_world(stored.env)
    caterer = _caterer(config, run_dir, world)
    address = listen(config.page.host, config.page.port)
    show = _shown(config, stored, run_dir, caterer, world)
    key = config.page.key or (secrets.token_urlsafe(9) if address.is_public else None)
    word = secrets.token_urlsafe(9)
    pages = ServePages(
        caterer,
        Pages(show.clips, language=config.page.language),
        shows=lambda member: show.of_member[member],
        numbers=show.numbers,
        word=word,
    )
    guard = guards(
        hosts=hosts_of(config.page.host),
        key=key,
        rate=config.page.rate,
        newcomers=config.page.newcomers,
    )
    return Serving(pages.app(guard), caterer, address, key, word)


def _caterer(config: ServeConfig, run_dir: Path, world: "World") -> "Caterer":
    """The set of a run, and what people may be asked about."""
    from popl_rl.data.environments import indexed
    from popl_rl.data.saved import load_segments
    from popl_rl.experiments.run_manifest import check_own_data
    from popl_rl.experiments.run_sets import load_own_set
    from popl_rl.randomness import stream
    from popl_rl.web.catering import Caterer, candidate_pairs
    from popl_rl.web.person_store import PersonStore

    options, data = config.serve, run_dir / "data"
    policies = load_own_set(run_dir, _place(run_dir).name)
    check_own_data(run_dir)
    if not (data / "segments").is_dir():
        raise ValueError(f"{run_dir} holds no data to ask about; train with data.save=true")
    segments = load_segments(data / "segments")
    read = indexed(segments, world.env.action_space)
    generator = stream(config.seed, "candidates")
    pairs = candidate_pairs(
        read, candidates=options.candidates, most=options.segments, generator=generator
    )
    (run_dir / "served").mkdir(exist_ok=True)
    return Caterer(
        policies,
        read,
        pairs,
        everybody=_everybody(run_dir, policies, read),
        store=PersonStore(run_dir / "served" / "answers.sqlite"),
        questions=options.questions,
        enough=options.enough,
        further=options.further,
    )


@dataclass(frozen=True)
class Show:
    """What people see: clips; those of each member, and of the one for all (None); numbers."""

    clips: "Clips"
    of_member: dict[int | None, list[int]]
    numbers: list["Number"]


def _shown(
    config: ServeConfig, stored: Config, run_dir: Path, caterer: "Caterer", world: "World"
) -> Show:
    """Clips of the segments and of what each member does, or likes best if it cannot act."""
    from popl_rl.experiments.data import build_world
    from popl_rl.experiments.progress import Progress
    from popl_rl.models.policy_set import PolicySet
    from popl_rl.web.clips import Clip
    from popl_rl.web.numbers import policy_numbers
    from popl_rl.web.rendering import Scenes, policy_clips, segment_clips

    policies, folder, env = caterer.policies, run_dir / "served", stored.env
    make_world = partial(build_world, env)
    seed = stored.seed if stored.data.seed is None else stored.data.seed
    wanted = caterer.pairs.unique().tolist()
    with Progress("clips", total=len(wanted)) as progress:
        scenes = Scenes(make_world, run_dir / "data", folder / "clips", seed)
        clips = dict(segment_clips(scenes, wanted, progress=progress.update))
    of_member: dict[int | None, list[int]] = {None: caterer.favourites(None)}
    of_member |= {member: caterer.favourites(member) for member in range(len(policies))}
    if not isinstance(policies, PolicySet):
        return Show(clips, of_member, [])
    alone = folder / "everybody"
    if not alone.exists():
        caterer.everybody.save(alone)
    behind = 1 + max(wanted)  # numbers that no segment has
    with Progress("policies", total=len(policies)) as progress:
        scenes = Scenes(
            make_world, _place(run_dir), folder / "policies", config.seed, env.max_steps
        )
        acted: dict[int | None, Clip] = dict(
            policy_clips(scenes, range(len(policies)), progress=progress.update).items()
        )
        scenes = replace(scenes, source=alone, folder=folder / "clip-for-everybody")
        acted[None] = policy_clips(scenes, [0])[0]
    for place, (member, clip) in enumerate(acted.items()):
        clips[behind + place], of_member[member] = clip, [behind + place]
    numbers = policy_numbers(
        policies,
        cast("PolicySet", caterer.everybody),
        world.make,
        success=env.success,
        door=env.door,
        measured=env.measured,
        episodes=config.serve.episodes,
        max_steps=env.max_steps,
        seed=config.seed,
    )
    return Show(clips, of_member, numbers)


def _everybody(
    run_dir: Path, policies: "HypothesisSet", segments: "TensorDictBase"
) -> "HypothesisSet":
    """The hypothesis for everybody: trained on all answers, or else the fair one of the set."""
    from popl_rl.experiments.run_sets import load_own_set
    from popl_rl.storage import load_tensordict

    if (run_dir / "baselines").is_dir():
        pooled = load_own_set(run_dir, "baselines").subset([0])
        if type(pooled) is type(policies):
            return pooled
    preferences = load_tensordict(run_dir / "data" / "preferences")
    return policies.subset([policies.fair(segments, preferences)])


def _place(run_dir: Path) -> Path:
    """Folder of the set of a run."""
    from popl_rl.models.policy_set import PolicySet
    from popl_rl.models.reward_set import RewardSet

    rewards = run_dir / RewardSet.folder
    return rewards if rewards.is_dir() else run_dir / PolicySet.folder


def run(config: ServeConfig) -> None:
    """Serve the page until Ctrl-C."""
    serving = prepare(config)
    from popl_rl.web.server import run

    url, key = serving.address.url, serving.key
    print(f"find a policy at {url}{'' if key is None else f'?key={key}'} ({serving.address.reach})")
    more = "" if key is None else f"&key={key}"
    print(f"researchers: {url}researcher?pass={serving.word}{more}; Ctrl-C ends it", flush=True)
    run(serving.app, serving.address)
    serving.caterer.store.database.close()


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="serve")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    config: ServeConfig = plain(cfg)
    validate(config)
    sys.stderr.write(f"serve {config.run_dir}: loading PyTorch\n")
    run(config)


def cli() -> None:
    """Console command ``popl-serve``."""
    run_command(main, ServeConfig)


if __name__ == "__main__":
    cli()
