"""The check of a method: a good one, and the same with one fault each."""

import gc

import pytest
import torch
from tensordict import TensorDict

from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.config import VPLSettings
from popl_rl.models.policies import build_network
from popl_rl.testing import check_method


class Good(MultiCPL):
    """Plain CPL, of which tests replace a part."""


class NoResult(Good):
    result = None


class NoGenerations(Good):
    def __init__(self, problem, *, generator):
        super().__init__(problem, generator=generator)
        self.generations = None


class BeginsWithOne(Good):
    def __init__(self, problem, *, generator):
        super().__init__(problem, generator=generator)
        self.generation = 1


class NoPopulation(Good):
    def __init__(self, problem, *, generator):
        super().__init__(problem, generator=generator)
        self.population = [build_network(problem.spec, generator=generator)]


class ReturnsNothing(Good):
    def step(self):
        super().step()


class DoesNotCount(Good):
    def step(self):
        said = super().step()
        self.generation -= 1
        return said


class ReturnsTensors(Good):
    def step(self):
        said = super().step()
        return {**said, "loss": torch.tensor(said["loss_cpl"])}


class Diverges(Good):
    def step(self):
        return {**super().step(), "loss_cpl": float("nan")}


class SaysNothingOfRaters(Good):
    def step(self):
        said = super().step()
        del said["worst_rater_accuracy"]
        return said


class SaysMoreLater(Good):
    def step(self):
        said = super().step()
        return said if self.generation == 1 else {**said, "late": 1.0}


class Lazy(Good):
    def step(self):
        before = self.population.members.data.clone()
        said = super().step()
        self.population.members.data.update_(before)
        return said


class Unseeded(Good):
    def step(self):
        self.population.members.data["0", "bias"].add_(torch.rand(()))
        return super().step()


class Remembering(Good):
    """Counts its objects, and does something else in each."""

    count = 0

    def step(self):
        said = super().step()
        if self.generation == 1:
            Remembering.count += 1
        return {**said, "count": float(Remembering.count)}


class Forgetful(Good):
    """Keeps neither its generator nor its optimiser."""

    def state_dict(self):
        members = self.population.members.data.clone().to_dict()
        return {"generation": self.generation, "members": members}

    def load_state_dict(self, state):
        self.generation = int(state["generation"])
        self.population.members.data.update_(state["members"])


class Unwritable(Good):
    def state_dict(self):
        return {**super().state_dict(), "loss": lambda: 0}


class Greedy(Good):
    """Throws away what was said after it has learnt from it."""

    def step(self):
        said = super().step()
        self.problem.comparisons.case.zero_()
        return said


class Spy(Good):
    """Looks for the hidden groups in memory."""

    def step(self):
        said = super().step()
        gc.collect()  # what earlier tests have left in circles is no finding
        data = [thing for thing in gc.get_objects() if type(thing) is TensorDict]
        groups = [thing["hidden", "group"] for thing in data if "hidden" in thing.keys()]  # noqa: SIM118
        return {**said, "groups": float(any((group < 0).any() for group in groups))}


class NoSet(Good):
    def result(self):
        return self.population


class NotFinite(Good):
    def result(self):
        found = super().result()
        found.alpha = float("nan")
        return found


class NotKept(Good):
    def result(self):
        found = super().result()
        found.save = lambda _: None
        return found


BROKEN = [
    (NoResult, TypeError, r"must have a method result\(\), but a NoResult has none"),
    (NoGenerations, TypeError, "must have generations, an int of at least 1, got None"),
    (BeginsWithOne, ValueError, "must begin with generation 0, got 1"),
    (NoPopulation, TypeError, "must have population, .*got a list; make one with problem.initial"),
    (ReturnsNothing, TypeError, "must return a dict of scalars by name, got a NoneType"),
    (DoesNotCount, ValueError, "must raise generation by 1, got 0 after 1 generations"),
    (ReturnsTensors, TypeError, r"must return numbers, got a Tensor for 'loss'; use float\(\)"),
    (Diverges, ValueError, "finite numbers, got nan for 'loss_cpl' in generation 1"),
    (SaysNothingOfRaters, ValueError, "must return worst_rater_accuracy.*got None among"),
    (SaysMoreLater, ValueError, "the same scalars each time.*in generation 2 .*'late'"),
    (Lazy, ValueError, "must learn, but after 3 generations every parameter"),
    (Unseeded, ValueError, "must draw from the generator that it is given"),
    (Remembering, ValueError, "a second run from the same seed must be equal.*count differs"),
    (
        Forgetful,
        ValueError,
        r"interrupted after .*state_dict\(\) must hold everything",
    ),
    (Unwritable, ValueError, r"writing its state_dict\(\) failed"),
    (Greedy, ValueError, "leave the problem as it is.*changed problem.comparisons.case"),
    (Spy, ValueError, "hidden keys are garbage .*groups differs.*may read the problem alone"),
    (NoSet, TypeError, r"result\(\) must return a set .*got a Population; use problem.hyp"),
    (NotFinite, ValueError, "positive alpha, got 0 that are not finite and alpha nan"),
    (NotKept, ValueError, "loading the result failed with FileNotFoundError"),
]


@pytest.mark.parametrize(("method", "error", "message"), BROKEN)
def test_each_fault_of_a_method_is_found(method, error, message):
    with pytest.raises(error, match=message):
        check_method(method)


def test_a_good_method_passes_and_leaves_the_global_randomness_alone():
    before = torch.random.get_rng_state()
    check_method(Good)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_options_and_sections_are_passed_on():
    with pytest.raises(ValueError, match=r"building it failed with TypeError.*'colour'"):
        check_method(Good, colour="red")
    with pytest.raises(ValueError, match=r"building it failed with ValueError: .*latent must be"):
        check_method("popl_rl.algorithms.vpl:VPL", sections={"vpl": VPLSettings(latent=0)})
