"""Bits flipped, files cut, removed, exchanged and linked: refused by name, or read as they were."""

import random
import shutil

import pytest
from omegaconf import OmegaConf

from popl_rl.config import Config, plain
from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.readers.writing import read_folder, write_folder
from popl_rl.experiments.data import build_groups, build_world, make_data
from popl_rl.experiments.run_manifest import check_own_data, load_run_config
from popl_rl.experiments.run_sets import load_own_set
from popl_rl.manifest import digest_of_tensors
from popl_rl.trainers import train_popl

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(2400)]

FLIPS, OTHERS = 600, 400
#: Of a run; what is not read again, such as figures, has nothing to say.
READ = ("manifest.json", "config.yaml", "data", "policies", "baselines")


@pytest.fixture(scope="module")
def saved(tmp_path_factory, tiny_settings, config_of):
    """Two runs that share a store, and people's data: folders ``one``, ``other``, ``people``."""
    root = tmp_path_factory.mktemp("saved")
    for name, more in {"one": ["seed=0"], "other": ["seed=1"]}.items():
        given = [*tiny_settings, *more, f"run_dir={root / name}", f"data.store={root / 'store'}"]
        train_popl.run(config_of(*given))
    segments, preferences = (
        make_everything(root / "one")[name] for name in ("segments", "preferences")
    )
    names = Names(items=[f"clip {number}" for number in range(len(segments))])
    write_folder(Imported(segments, preferences.exclude("hidden"), names), root / "people")
    return root


def make_everything(run):
    """Whatever is read of a run when it is evaluated again."""
    config = plain(OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run)))
    world = WORLD.setdefault("world", build_world(config.env))
    check_own_data(run)
    groups = build_groups(config.raters, world)
    data = make_data(
        config.data, config.raters, world, groups, seed=0, env=config.env, load=run / "data"
    )
    sets = {name: load_own_set(run, name) for name in ("policies", "baselines")}
    return {"config": config, "segments": data.steps, "preferences": data.preferences, **sets}


WORLD = {}


def look(root):
    """Digests of all that is read."""
    found = {}
    for name in ("one", "other"):
        everything = make_everything(root / name)
        found[name, "config"] = repr(everything["config"])
        for part in ("segments", "preferences"):
            found[name, part] = digest_of_tensors(everything[part])[""]
        for part in ("policies", "baselines"):
            one = everything[part]
            about = (one.alpha, one.discount, one.origin, one.fair_member)
            found[name, part] = (about, digest_of_tensors(one.population.members.data)[""])
    people = read_folder(root / "people")
    found["people"] = [digest_of_tensors(data)[""] for data in people[:2]] + [people.names]
    return found


def files_of(root):
    parts = [root / run / part for run in ("one", "other") for part in READ]
    parts += [root / "people", root / "store"]
    files = {path for part in parts for path in [part, *part.rglob("*")] if path.is_file()}
    return sorted(path for path in files if not path.name.endswith(".lock"))


def judge(root, expected, what, problems):
    """Add to the problems unless what was damaged is refused by name, or does no harm."""
    try:
        found = look(root)
    except (ValueError, OSError) as error:
        if str(root) not in str(error):
            problems.append(f"{what}: no name in: {error}")
    except Exception as error:
        problems.append(f"{what}: {type(error).__name__}: {error}")
    else:
        if found != expected:
            wrong = [key for key in expected if found[key] != expected[key]]
            problems.append(f"{what}: read as something else: {wrong}")


def test_flipped_bits(saved, part, tmp_path):
    expected, draw, problems = look(saved), random.Random(0), []
    files = [path for path in files_of(saved) if path.stat().st_size]
    for case in part(list(range(FLIPS))):
        path = draw.choice(files)
        whole = path.read_bytes()
        place, bit = draw.randrange(len(whole)), draw.randrange(8)
        damaged = bytearray(whole)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        judge(saved, expected, f"{case}: bit {bit} of byte {place} of {path}", problems)
        path.write_bytes(whole)
    assert problems == []
    assert look(saved) == expected


def cut(path, other, draw):
    path.write_bytes(path.read_bytes()[: draw.randrange(max(1, path.stat().st_size))])


def lengthened(path, other, draw):
    path.write_bytes(path.read_bytes() + draw.randbytes(1 + draw.randrange(9)))


def zeroed(path, other, draw):
    path.write_bytes(bytes(path.stat().st_size))


def removed(path, other, draw):
    path.unlink()


def exchanged(path, other, draw):
    one, two = path.read_bytes(), other.read_bytes()
    path.write_bytes(two)
    other.write_bytes(one)


def replaced(path, other, draw):
    path.write_bytes(other.read_bytes())


def linked(path, other, draw):
    path.unlink()
    path.symlink_to(other)


def linked_to_nothing(path, other, draw):
    path.unlink()
    path.symlink_to(path.parent / "nothing")


def linked_to_itself(path, other, draw):
    path.unlink()
    path.symlink_to(path)


def a_folder(path, other, draw):
    path.unlink()
    path.mkdir()


DAMAGES = [cut, cut, lengthened, zeroed, removed, exchanged, replaced, linked]
DAMAGES += [linked_to_nothing, linked_to_itself, a_folder]


def twin(path, saved):
    """The same file of the other run, or a file beside it, in turn."""
    swapped = {"one": "other", "other": "one"}
    inner = path.relative_to(saved).parts
    return saved.joinpath(swapped.get(inner[0], inner[0]), *inner[1:])


def test_cuts_swaps_and_links(saved, part, tmp_path):
    expected, draw, problems = look(saved), random.Random(1), []
    names = [path.relative_to(saved) for path in files_of(saved)]
    for case in part(list(range(OTHERS))):
        root = tmp_path / str(case)
        shutil.copytree(saved, root, symlinks=True)
        damage, name = DAMAGES[case % len(DAMAGES)], draw.choice(names)
        other = root / draw.choice(names)
        if draw.random() < 0.5 and twin(root / name, root).is_file():
            other = twin(root / name, root)
        damage(root / name, other, draw)
        judge(root, expected, f"{case}: {name} {damage.__name__} ({other})", problems)
        shutil.rmtree(root)
    assert problems == []


@pytest.mark.parametrize("folder", ["data", "data/segments", "data/preferences", *READ[3:]])
def test_folders_of_another_run(saved, tmp_path, folder):
    root = tmp_path / "root"
    shutil.copytree(saved, root, symlinks=True)
    one, other = root / "one" / folder, root / "other" / folder
    if one.is_symlink():
        target = other.readlink()
        one.unlink()
        one.symlink_to(target)
    else:
        shutil.rmtree(one)
        shutil.copytree(other, one, symlinks=True)
    with pytest.raises(ValueError, match=str(root)):
        make_everything(root / "one")
