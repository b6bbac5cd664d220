"""Have people compare clips on a page: ``popl-label``.

popl-label out=labels                                        # makes segments of two doors first
popl-label data.load=runs/mine/data out=labels
popl-label out=labels label.pairs=disagreement label.policies=runs/mine/policies
popl-train data.load=labels evaluation.baselines=false       # trains on what people said

The page says which of two clips is better, by buttons or keys; ``out`` holds the segments, clips
and answers, and the same command goes on where it was stopped.
"""

import secrets
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra

from popl_rl.config import LabelConfig, plain, validate
from popl_rl.trainers.command import register_schemas, run_command

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from popl_rl.web.clips import Clips
    from popl_rl.web.label_store import LabelStore
    from popl_rl.web.server import Address


@dataclass(frozen=True)
class Labelling:
    """A page that is ready to run.

    Attributes:
        app: The application.
        store: Raters and answers.
        address: Where it listens.
        export: Writes answers as data to train on.
        key: Word that visitors need; None for none.
    """

    app: "Starlette"
    store: "LabelStore"
    address: "Address"
    export: Callable[[], int]
    key: str | None


def prepare(config: LabelConfig) -> Labelling:
    """Everything up to the first visitor: segments, pairs, clips, page.

    Raises:
        ValueError: If settings are off or do not go together.
    """
    config = plain(config)
    validate(config)
    from popl_rl.web.extra import require_extra

    require_extra()
    from popl_rl.web.guards import guards, hosts_of
    from popl_rl.web.label_app import LabelPages
    from popl_rl.web.label_store import LabelStore
    from popl_rl.web.labels import export
    from popl_rl.web.pages import Pages
    from popl_rl.web.server import listen

    options, out = config.label, Path(config.out)
    address = listen(config.page.host, config.page.port)
    pairs, clips = _material(config, out)
    store = LabelStore(
        out / "answers.sqlite",
        pairs,
        raters_per_pair=options.raters_per_pair,
        answers=options.answers,
        attention=options.attention,
    )
    text = options.instructions
    pages = LabelPages(
        store,
        Pages(clips, language=config.page.language),
        instructions=None if text is None else Path(text).read_text(encoding="utf-8"),
        pause=options.pause,
    )
    key = config.page.key or (secrets.token_urlsafe(9) if address.is_public else None)
    guard = guards(
        hosts=hosts_of(config.page.host),
        key=key,
        rate=config.page.rate,
        newcomers=config.page.newcomers,
    )
    return Labelling(pages.app(guard), store, address, lambda: export(store, out), key)


def _material(config: LabelConfig, out: Path) -> tuple[list[tuple[int, int]], "Clips"]:
    """Which pairs are compared, and what people see of them."""
    from popl_rl.data.saved import load_segments
    from popl_rl.experiments.data import build_world
    from popl_rl.experiments.label_data import gather_segments
    from popl_rl.experiments.progress import Progress
    from popl_rl.models.sets import load_set
    from popl_rl.randomness import stream
    from popl_rl.web.labels import choose_pairs, kept_pairs
    from popl_rl.web.rendering import Scenes, segment_clips

    options, env = config.label, config.env
    with Progress("segments", total=config.data.segments) as progress:
        seed = gather_segments(config.data, env, out, seed=config.seed, progress=progress.update)
    chosen = None
    if not (out / "pairs.json").exists():
        segments = load_segments(out / "segments")
        chosen = choose_pairs(
            segments,
            options.pairs,
            count=options.count,
            policies=None if options.policies is None else load_set(options.policies),
            generator=stream(config.seed, "label pairs"),
        )
    pairs = kept_pairs(out / "pairs.json", chosen)
    wanted = sorted({segment for pair in pairs for segment in pair})
    with Progress("clips", total=len(wanted)) as progress:
        scenes = Scenes(partial(build_world, env), out, out / "clips", seed)
        return pairs, segment_clips(scenes, wanted, progress=progress.update)


def run(config: LabelConfig) -> None:
    """Serve the page until Ctrl-C; answers become data every few seconds."""
    labelling = prepare(config)
    from popl_rl.web.server import regularly, run

    place = labelling.address.url + ("" if labelling.key is None else f"?key={labelling.key}")
    print(f"compare clips at {place} ({labelling.address.reach}); Ctrl-C ends it", flush=True)
    with regularly(labelling.export, seconds=5):
        run(labelling.app, labelling.address)
    answers = len(labelling.store.given())
    labelling.store.database.close()
    print(f"{answers} answers in {config.out}: popl-train data.load={config.out}")


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="label")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    config: LabelConfig = plain(cfg)
    validate(config)
    sys.stderr.write(f"label {config.env.factory}: loading PyTorch\n")
    run(config)


def cli() -> None:
    """Console command ``popl-label``."""
    run_command(main, LabelConfig)


if __name__ == "__main__":
    cli()
