import errno
import shutil
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from popl_rl.experiments import reevaluation
from popl_rl.trainers import evaluate_policies, train_popl

RATERS = """
import torch


def fails(segments):
    raise RuntimeError("my mistake")


def flat(segments):
    return segments["observation"].sum((-1, -2))


def nan(segments):
    return torch.full(segments.batch_size, float("nan"))
"""


@pytest.fixture
def call(monkeypatch, tmp_path, capsys):
    """Run a command as from the shell, in an empty folder: exit code and what was printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def call(command, *overrides):
        monkeypatch.setattr(sys, "argv", ["popl", *map(str, overrides)])
        code = 0
        try:
            command()
        except SystemExit as leave:
            code = leave.code
        out, err = capsys.readouterr()
        return code, out + err

    return call


@pytest.fixture
def train(call, tiny):
    return lambda *overrides: call(train_popl.cli, *tiny, "run_dir=run", *overrides)


@pytest.fixture(scope="module")
def finished(finished):
    """Folder of a finished run; not to be changed."""
    return finished.run_dir


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copied"))


def assert_explains(result, *parts):
    code, text = result
    assert code == 2, text
    assert "Traceback" not in text
    message = text[text.index("error:") :]
    for part in parts:
        assert part in message, message


def test_a_run_and_its_evaluations(train, call, tmp_path):
    code, text = train()
    assert code == 0, text
    assert "upper" in text
    assert "report, pictures, policies and logs: run" in text
    for number in ("001", "002"):
        settings = ["evaluation.episodes=3", "evaluation.new_raters=2", "evaluation.pairs=50"]
        code, text = call(evaluate_policies.cli, "run_dir=run", "seed=5", *settings)
        assert code == 0, text
        assert f"evaluations/{number}" in text
        folder = tmp_path / "run" / "evaluations" / number
        found = {path.name for path in folder.iterdir()}
        assert found == {"config.yaml", "results.csv", "report.md"}
    folder = tmp_path / "run" / "evaluations"
    one, other = ((folder / number / "results.csv").read_bytes() for number in ("001", "002"))
    assert one == other


def test_evaluating_with_the_runs_seed_gives_its_results(call, finished, copied):
    code, text = call(evaluate_policies.cli, f"run_dir={copied}", "seed=0")
    assert code == 0, text
    again = (copied / "evaluations" / "001" / "results.csv").read_bytes()
    assert again == (finished / "results.csv").read_bytes()


def test_evaluating_keeps_the_runs_settings_and_asks_other_raters(
    call, finished, copied, monkeypatch
):
    found = []
    original = reevaluation.make_evaluator

    def watch(*arguments, **options):
        found.append(original(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(reevaluation, "make_evaluator", watch)
    for overrides in (["seed=0"], ["evaluation.answers=3", "evaluation.reference=others"]):
        code, text = call(evaluate_policies.cli, f"run_dir={copied}", *overrides)
        assert code == 0, text
    own = OmegaConf.load(finished / "config.yaml")
    used = OmegaConf.load(copied / "evaluations" / "002" / "config.yaml")
    expected = OmegaConf.merge(own.evaluation, {"answers": 3, "reference": "others"})
    assert used.evaluation == expected
    assert used.seed == own.seed + 1
    same, other = found
    for group in (0, 1):
        assert not torch.equal(same.pairs[group][0], other.pairs[group][0])
        for one, another in zip(same.new_raters[group], other.new_raters[group], strict=True):
            assert not torch.equal(one["pair"][:5], another["pair"][:5])
    assert same.acting.seed != other.acting.seed


def test_evaluating_with_unknown_settings(call, copied):
    result = call(evaluate_policies.cli, f"run_dir={copied}", "evaluation.anwsers=5")
    assert_explains(result, "Could not override 'evaluation.anwsers'")
    result = call(evaluate_policies.cli, f"run_dir={copied}", "+evaluation.anwsers=5")
    assert_explains(result, "anwsers", "EvaluationConfig")
    assert not (copied / "evaluations").exists()


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["env.factory=two_dors"], ["unknown env 'two_dors'", "Did you mean 'two_doors'"]),
        (["env.options.doors=7"], ["doors must be 2, 3 or 4, got 7"]),
        (["raters.groups=[upper,sideways]"], ["unknown rater 'sideways'", "Known: ", "lower"]),
        (["raters.groups=[nobody.py:slow]"], ["nobody.py", "there is no Python file"]),
        (["method=mine"], ["unknown method 'mine'", "popl_published"]),
        (["env=mine"], ["unknown env 'mine'", "two_doors"]),
        (["method.membres=3"], ["membres", "method"]),
        (["method.members=many"], ["many", "method.members"]),
        (["method.members=1"], ["method.members must be at least 2", "got 1"]),
        (["method.popl.epsilon=much"], ["method.popl.epsilon must be mad", "'much'"]),
        (["method.em.groups=3"], ["method.em.groups is not read by method 'popl'", "by em"]),
        (
            ["raters.shares=[0.5,0.6]"],
            ["raters.shares must be non-negative and sum to 1", "[0.5, 0.6]"],
        ),
        (["raters.shares=[1.0]"], ["raters.shares must be one number per group (2)"]),
        (["data.length=100"], ["100", "20"]),
        (["data.load=nowhere"], ["data.load", "'data'", "nowhere"]),
        (["raters.response.tie=1e9"], ["strict answer", "ties", "lower"]),
    ],
    ids=lambda value: value[0] if isinstance(value[0], str) and "=" in value[0] else "",
)
def test_what_the_user_can_put_right(train, overrides, parts):
    assert_explains(train(*overrides), *parts)


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (
            ["seeds=1"],
            ["Could not override 'seeds': there is no ", "Did you mean 'seed'?"],
        ),
        (["raters.response.mistakes=0.2"], ["Did you mean 'raters.response.mistake'? --cfg job"]),
        (["mistake=0.2"], ["Did you mean 'raters.response.mistake'?"]),
        (["raters=three_group"], ["unknown raters 'three_group'. Did you mean 'three_groups'?"]),
        (["env=metaworld/drawer"], ["unknown env 'metaworld/drawer'.", "Known:", "two_doors"]),
        (["method=pople"], ["unknown method 'pople'. Did you mean 'popl'? Known: cpl, em, "]),
    ],
)
def test_what_is_misspelt(call, overrides, parts):
    assert_explains(call(train_popl.cli, *overrides), *parts)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["raters.groups=[uper,lower]"], "Did you mean 'upper'?"),
        (["env.factory=two_dors"], "Did you mean 'two_doors'?"),
        (["method.factory=x.py:Mine", "method.reads=[training,refinement]"], "no Python file"),
    ],
)
def test_what_cannot_be_found_leaves_no_folder(train, tmp_path, overrides, said):
    assert_explains(train(*overrides), said)
    assert not (tmp_path / "run").exists()


def test_a_setting_that_must_be_given(call, tiny):
    assert_explains(call(train_popl.cli, *tiny[1:], "env=gym"), "env.id", "CartPole")
    assert_explains(call(train_popl.cli, *tiny[1:], "env=custom"), "env.factory", "my_env.py")


def test_several_problems_are_told_at_once(train):
    assert_explains(train("method.members=1", "raters.count=0"), "method.members", "raters.count")


@pytest.mark.parametrize(
    ("function", "parts"),
    [
        ("fails", ["fails", "RuntimeError", "my mistake"]),
        ("flat", ["flat", "shape"]),
        ("nan", ["nan", "finite"]),
        ("missing", ["missing", "It defines: fails, flat, nan"]),
    ],
)
def test_a_faulty_rater_of_the_user(train, tmp_path, function, parts):
    (tmp_path / "mine.py").write_text(RATERS)
    assert_explains(train(f"raters.groups=['mine.py:{function}']", "raters.label=return"), *parts)


def test_a_folder_that_is_taken(train, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep me")
    assert_explains(train(), "run_dir run exists", "choose another run_dir", "resume=run")
    assert (tmp_path / "run" / "mine.txt").read_text() == "keep me"


def test_resuming_what_is_no_run(call, tmp_path):
    (tmp_path / "other").mkdir()
    for folder in ("other", "nowhere"):
        result = call(train_popl.cli, f"resume={folder}")
        assert_explains(result, f"no run to resume in {folder}", "config.yaml")


def test_resuming_a_finished_run_changes_nothing(call, finished, copied):
    code, text = call(train_popl.cli, f"resume={copied}")
    assert code == 0, text
    for name in ("results.csv", "metrics.csv", "history.csv", "report.md"):
        assert (copied / name).read_bytes() == (finished / name).read_bytes()


def test_evaluating_what_is_no_run(call, tmp_path):
    assert_explains(call(evaluate_policies.cli), "run_dir")
    assert_explains(call(evaluate_policies.cli, "run_dir=nowhere"), "nowhere", "config.yaml")


def test_evaluating_a_truncated_policy_set(call, copied):
    tensor = max((copied / "policies" / "members").rglob("*.memmap"))
    tensor.write_bytes(tensor.read_bytes()[:-4])
    result = call(evaluate_policies.cli, f"run_dir={copied}")
    assert_explains(result, "policies", "truncated", "train again")
    assert not (copied / "evaluations").exists()


def test_evaluating_a_run_that_is_not_finished(call, copied):
    shutil.rmtree(copied / "policies")
    assert_explains(call(evaluate_policies.cli, f"run_dir={copied}"), "no policy set", "finished")


def test_evaluating_with_impossible_settings(call, copied):
    result = call(evaluate_policies.cli, f"run_dir={copied}", "people.repeats=2")
    assert_explains(result, "people.repeats", "simulated raters")
    result = call(evaluate_policies.cli, f"run_dir={copied}", "evaluation.episodes=0")
    assert_explains(result, "episodes must be at least 1, got 0")


def test_a_single_rater(train):
    """One person has one taste: the other group's oracle has nothing to learn from."""
    assert_explains(train("raters.count=1"), "no strict answer", "no oracle", "more raters")


def test_a_single_rater_without_baselines(train):
    code, text = train("raters.count=1", "evaluation.baselines=false")
    assert code == 0, text


def test_a_single_group(train):
    code, text = train("raters.groups=[upper]")
    assert code == 0, text


def test_interrupting(train, monkeypatch, tmp_path):
    def interrupt(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("popl_rl.algorithms.popl.POPL.step", interrupt)
    code, text = train()
    assert code == 130
    assert "resume=" in text
    assert "Traceback" not in text
    assert (tmp_path / "run" / "config.yaml").is_file()


def test_a_full_disk(train, monkeypatch):
    original = Path.open

    def full(self, *arguments, **options):
        if self.name == "metrics.csv" and arguments[:1] == ("a",):
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(self, *arguments, **options)

    monkeypatch.setattr(Path, "open", full)
    assert_explains(train(), "metrics.csv", "the disk is full", "free some space")


def test_a_defect_keeps_its_traceback(call, monkeypatch):
    def broken(config):
        raise AssertionError("ours")

    monkeypatch.setattr(train_popl, "run", broken)
    with pytest.raises(AssertionError, match="ours"):
        call(train_popl.cli)


def test_full_errors_on_request(call, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(FileNotFoundError, match="no run to resume"):
        call(train_popl.cli, "resume=nowhere")
