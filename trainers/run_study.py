"""Studies on data of real people, which lie in a folder of yours: ``popl-study``.

popl-study delivery path/to/data                    # runs/study-delivery
popl-study delivery_policies path/to/data
popl-study arguments path/to/data --encode tfidf
popl-study arguments path/to/data --encode path/to/language-model --out runs/mine
popl-study jailbreaks path/to/data --encode path/to/language-model

The folder holds delivery.npz, or arguments.csv.gz beside arguments_comparisons.csv.gz, or
dialogues.jsonl.gz beside jailbreaks.jsonl.gz. Further settings are overrides, as of popl-people.
The same command goes on after a kill, with the settings that it began with.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popl_rl.trainers import import_data, judge_people
from popl_rl.trainers.command import USER_ERRORS, prepare
from popl_rl.trainers.composing import compose_settings
from popl_rl.trainers.terminal import steady_terminal

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["STUDIES", "cli", "main"]

STUDIES = ("delivery", "delivery_policies", "arguments", "jailbreaks")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study; returns the exit code."""
    parser = argparse.ArgumentParser("popl-study", description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("folder", type=Path, help="where the data are")
    parser.add_argument("setting", nargs="*", help="overrides, such as people.folds=3")
    parser.add_argument("--out", type=Path, help="folder of the study; runs/study-<name>")
    parser.add_argument("--encode", default="tfidf", help="tfidf, or a language model's folder")
    given = parser.parse_intermixed_args(arguments)
    out = given.out or Path("runs", f"study-{given.study}")
    try:
        if given.study == "jailbreaks":
            _jailbreaks(given.folder, out, given.encode, given.setting)
            return 0
        if given.study == "arguments":
            data = _import_arguments(given.folder, out, given.encode)
        else:
            data = given.folder / "delivery.npz"
        config = _config(given.study, data, out, given.setting)
        result = judge_people.run(config)
        rows = result.results
        if given.study == "arguments":
            _tell_arguments(out)
        else:
            _tell_delivery(data, out)
            rows = _with_kinds(rows, out / "comparison")
        _write_rows(given.study, rows, out)
        judge_people.show(result)
    except USER_ERRORS as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def _config(study: str, data: Path, out: Path, settings: Sequence[str]) -> Any:
    if (out / "comparison" / "config.yaml").is_file():
        overrides = [f"resume={out / 'comparison'}"]
    else:
        overrides = [f"study={study}", f"data.load={data}", f"run_dir={out / 'comparison'}"]
    return compose_settings([*overrides, *settings], name="people")


def _jailbreaks(folder: Path, out: Path, encode: str, settings: Sequence[str]) -> None:
    """Train heads on dialogues, and write and print how they judge."""
    from popl_rl.experiments import jailbreak_study, steps

    config = prepare(_config("jailbreaks", folder / "dialogues.jsonl.gz", out, settings))
    is_new = config.resume is None
    with steps.open_run(config, command=sys.argv) as (config, run_dir, _):
        with steps.kept_unless_refused(run_dir, is_new=is_new):
            data = jailbreak_study.read_dialogues(folder, encode, cache=out)
        methods = tuple(config.people.methods)
        cells = run_dir / "cells"
        rows = jailbreak_study.jailbreak_rows(data, config, methods=methods, cells=cells)
    _write_rows("jailbreaks", rows, out)
    shown = rows[~rows["measure"].str.contains("_low|_high")]
    table = shown.pivot_table("value", ["method", "choice"], ["measure", "group"], sort=False)
    print(table.round(3).to_string())
    print(f"all rows, with their intervals: {out / 'results.csv'}")


def _import_arguments(folder: Path, out: Path, encode: str) -> Path:
    """Items with features of their texts, made once."""
    target = out / "data"
    if not target.is_dir():
        options = [f"items={folder / 'arguments.csv.gz'}", f"encode={encode}", f"cache={out}"]
        code = import_data.main(
            [str(folder / "arguments_comparisons.csv.gz"), str(target), *options]
        )
        if code:
            raise ValueError(f"the arguments in {folder} could not be imported, see above")
    return target


def _tell_delivery(data: Path, out: Path) -> None:
    """What held-out people are given does on the board, and how people answer."""
    from omegaconf import OmegaConf

    from popl_rl.config import Config, plain
    from popl_rl.data.readers.opening import open_data
    from popl_rl.experiments import delivery_study, response_study
    from popl_rl.experiments.people import people_of
    from popl_rl.experiments.run_manifest import load_run_config
    from popl_rl.plotting.delivery_plots import delivery_walks
    from popl_rl.plotting.style import save
    from popl_rl.registry import resolve
    from popl_rl.storage import write_atomic

    run_dir = out / "comparison"
    config = plain(OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run_dir)))
    read = open_data(data, reader=config.data.reader, options=config.data.reader_options)
    people = people_of(read, config.method)
    grid = resolve("env", "delivery")(board=str(data))
    acting = delivery_study.act_for_people(config, people, grid, run_dir / "cells")
    write_atomic(out / "acting.csv", acting.returns.to_csv(index=False))
    save(delivery_walks(grid, acting.policies), out / "walks.png")
    info = read.segments["info"]
    walks = info["state"] * grid.actions + info["taken"]
    fits = response_study.response_fits(people, grid, walks)
    write_atomic(out / "response.csv", fits.to_csv(index=False))
    persons = response_study.person_fits(people, grid, walks)
    write_atomic(out / "response_people.csv", persons.to_csv(index=False))
    means = acting.returns.groupby(["method", "group"])[["greedy", "planned"]].mean()
    print(means.round(3).to_string())
    print(fits.round(3).to_string(index=False))
    print(persons.describe().loc[["25%", "50%", "75%"]].round(3).to_string())


def _with_kinds(rows: "pd.DataFrame", run_dir: Path) -> "pd.DataFrame":
    """Rows of all people who were led to look at the same, besides those of their conditions."""
    import pandas as pd

    from popl_rl.evaluation.people_statistics import summarise_people
    from popl_rl.experiments.delivery_study import led_to

    people = pd.read_csv(run_dir / "people.csv", keep_default_na=False, dtype={"person": "str"})
    people["group"] = people["group"].map(led_to)
    kinds = summarise_people(people, references=[("pooled_cpl", ""), ("individual", "")])
    return pd.concat([rows, kinds[kinds["group"] != "all"]], ignore_index=True)


def _tell_arguments(out: Path) -> None:
    """What the members of the first fold's set want, and the pairs that tell them apart."""
    from popl_rl.config import MethodConfig
    from popl_rl.data.readers.writing import read_folder
    from popl_rl.experiments import argument_study
    from popl_rl.experiments.people import people_of
    from popl_rl.models.sets import load_set
    from popl_rl.storage import write_atomic

    people = people_of(read_folder(out / "data"), MethodConfig(hidden=[]))
    found = load_set(out / "comparison" / "cells" / "popl-0")
    scores = argument_study.text_scores(found, people)
    wants = argument_study.wants(scores, people.data.names.texts)
    print("what members want (rank correlations of their scores)")
    print(wants.to_string())
    write_atomic(out / "wants.csv", wants.to_csv(index_label="member"))
    if len(found) < 2:
        return
    low, high = int(wants["length"].argmin()), int(wants["length"].argmax())
    pairs = argument_study.telling_pairs(scores, people, one=low, other=high)
    text = "\n\n".join(
        f"## Pair {place}\n\nMember {low} prefers:\n\n> {left}\n\n"
        f"Member {high} prefers:\n\n> {right}"
        for place, (left, right) in enumerate(pairs, 1)
    )
    write_atomic(out / "pairs.md", f"# The most telling pairs\n\n{text}\n")


def _write_rows(study: str, results: "pd.DataFrame", out: Path) -> None:
    """Rows as of a benchmark, for ``python -m popl_rl.trainers.make_tables``."""
    from popl_rl.storage import write_atomic

    rows = results.assign(suite=study, scenario=study, seed=0)
    columns = ["suite", "scenario", "seed", *results.columns]
    write_atomic(out / "results.csv", rows[columns].to_csv(index=False))


def cli() -> None:
    """Console command ``popl-study``."""
    with steady_terminal():
        sys.exit(main())


if __name__ == "__main__":
    cli()
