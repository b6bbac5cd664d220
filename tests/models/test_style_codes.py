import pytest
import torch
from tensordict import TensorDict

from popl_rl.algorithms.losses import CPLLoss, cpl_loss
from popl_rl.data.bank import SegmentBank
from popl_rl.models import scoring
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.scoring import segment_scores
from popl_rl.models.style_codes import StyleClone, load_clone, save_clone, train_clone
from popl_rl.models.style_population import StyledPopulation

SPEC = PolicySpec(2, 1, False, (16,))


@pytest.fixture(scope="module")
def bank():
    """Half of the segments act as the first coordinate says, half twice as strongly."""
    generator = torch.Generator().manual_seed(0)
    observation = torch.rand(200, 8, 2, generator=generator) + 0.5
    strength = 1.0 + (torch.arange(200) % 2).view(-1, 1, 1)
    action = strength * observation[..., :1]
    row = torch.arange(1600).view(200, 8)
    return SegmentBank(observation.flatten(0, 1), row, action, False)


@pytest.fixture(scope="module")
def clone(bank):
    generator = torch.Generator().manual_seed(0)
    return train_clone(SPEC, bank, steps=600, batch_size=64, looks=4, generator=generator)


def test_codes_tell_styles_apart_and_the_decoder_acts_in_them(clone, bank):
    codes = clone.codes
    apart = (codes[0::2].mean(0) - codes[1::2].mean(0)).abs() / codes.std(0)
    assert apart.max() > 1.5
    population = StyledPopulation(clone, torch.stack([codes[0::2].mean(0), codes[1::2].mean(0)]))
    seen = torch.tensor([[0.6, 1.0], [1.2, 1.0]])
    weak, strong = population(seen).squeeze(-1)
    assert torch.allclose(weak, seen[:, 0], atol=0.2)
    assert torch.allclose(strong, 2 * seen[:, 0], atol=0.3)


def test_what_is_typical_lies_between(clone):
    assert (clone.typical() >= clone.low).all()
    assert (clone.typical() <= clone.high).all()
    drawn = clone.draw(50, generator=torch.Generator().manual_seed(0))
    assert drawn.shape == (50, 2)
    assert ((drawn >= clone.low) & (drawn <= clone.high)).all()


def test_the_same_seed_gives_the_same_clone(bank):
    def codes(seed):
        generator = torch.Generator().manual_seed(seed)
        return train_clone(SPEC, bank, steps=5, batch_size=8, looks=2, generator=generator).codes

    assert torch.equal(codes(0), codes(0))
    assert not torch.equal(codes(0), codes(1))


def test_progress_and_bad_numbers(bank):
    told = []
    generator = torch.Generator().manual_seed(0)
    train_clone(
        SPEC, bank, steps=60, batch_size=4, looks=2, generator=generator, progress=told.append
    )
    assert told == [50, 60]
    for name in ("code_dim", "steps", "batch_size", "looks"):
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            train_clone(SPEC, bank, generator=generator, **{name: 0})
    with pytest.raises(ValueError, match="beta must be at least 0"):
        train_clone(SPEC, bank, generator=generator, beta=-1.0)


def test_discrete_actions_are_cloned_too():
    generator = torch.Generator().manual_seed(0)
    spec = PolicySpec(2, 3, True, (8,))
    row = torch.arange(80).view(20, 4)
    action = torch.randint(3, (20, 4), generator=generator)
    bank = SegmentBank(torch.rand(80, 2, generator=generator), row, action, False)
    clone = train_clone(spec, bank, steps=3, batch_size=4, looks=2, generator=generator)
    assert StyledPopulation(clone, clone.codes[:4])(bank.observation).shape == (4, 80, 3)


def test_a_saved_clone_comes_back(clone, tmp_path):
    save_clone(clone, tmp_path / "clone")
    loaded = load_clone(SPEC, tmp_path / "clone")
    for name, value in clone.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)
    with pytest.raises(ValueError, match="style clone of other sizes"):
        load_clone(PolicySpec(3, 1, False, (16,)), tmp_path / "clone")


@pytest.fixture
def styled(clone):
    return StyledPopulation(clone, clone.draw(5, generator=torch.Generator().manual_seed(1)))


def test_members_are_ordinary_networks_for_their_codes(styled, bank):
    plain = styled.plain()
    assert isinstance(plain, Population)
    seen = bank.observation[:30]
    assert torch.allclose(styled(seen), plain(seen), atol=1e-5)
    told = torch.cat([seen, styled.members["code"][2].expand(30, -1)], -1)
    assert torch.allclose(styled.clone.network(told), plain(seen)[2], atol=1e-5)
    one, other = segment_scores(styled, bank, alpha=0.3), segment_scores(plain, bank, alpha=0.3)
    assert torch.allclose(one, other, atol=1e-4)


@pytest.mark.parametrize("memory_mb", [256.0, 0.01])
def test_scores_do_not_depend_on_the_chunks(styled, bank, memory_mb):
    scores = segment_scores(styled, bank, memory_mb=memory_mb)
    alone = [segment_scores(styled.subset([index]), bank)[0] for index in range(5)]
    assert torch.allclose(scores, torch.stack(alone), atol=1e-4)


def test_equal_codes_are_scored_once(clone, bank, monkeypatch):
    """Every member has the scores of its own network, wherever its code comes again."""
    codes = torch.stack([clone.low, clone.high, clone.low, clone.typical(), clone.high])
    population = StyledPopulation(clone, codes)
    expected = segment_scores(population.plain(), bank)
    looked_at = []
    apply_layers = scoring.apply_layers

    def counted(layers, seen):
        output = apply_layers(layers, seen)
        looked_at.append(output.shape[0] * output.shape[1])
        return output

    monkeypatch.setattr(scoring, "apply_layers", counted)
    assert torch.allclose(segment_scores(population, bank), expected, atol=1e-3)
    assert sum(looked_at) == 3 * bank.row.numel()
    distinct = StyledPopulation(clone, codes[[0, 1, 3]])
    assert distinct.without_repeats() == (distinct, None)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    "spec", [SPEC, PolicySpec(2, 3, True, (6, 5)), PolicySpec(2, 2, False, ())], ids=str
)
def test_scores_and_gradients_are_those_of_autograd(generator, spec, masked, shared):
    """Of whole batches at once; by blocks of a few segments here."""
    shape = 40, 8 if spec.discrete else 64
    observation = torch.randn(shape[0] * shape[1], 2, generator=generator)
    row = torch.arange(len(observation)).view(shape)
    mask = torch.rand(shape, generator=generator) < 0.7 if masked else None
    action = torch.randn(*shape, spec.action_dim, generator=generator)
    if spec.discrete:
        action = torch.randint(spec.action_dim, shape, generator=generator)
    bank = SegmentBank(observation, row, action, False, mask)
    clone = StyleClone(spec, torch.randn(9, 2, generator=generator))
    population = StyledPopulation(clone, clone.draw(3, generator=generator))
    segment = torch.randint(40, (50,) if shared else (3, 50), generator=generator)
    weight = 0.3 * bank.weights(segment, discount=0.9)
    slope = torch.randn(3, 50, generator=generator)

    def scored(way):
        scores = way(population, bank, segment, weight)
        (gradient,) = torch.autograd.grad((scores * slope).sum(), population.members.parameters())
        return scores, gradient

    found, expected = scored(StyledPopulation.drawn_scores), scored(Population.drawn_scores)
    torch.testing.assert_close(found[0], expected[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found[1], expected[1], atol=1e-4, rtol=1e-5)
    with torch.no_grad():
        assert torch.equal(population.drawn_scores(bank, segment, weight), expected[0])


def test_only_codes_learn(styled, bank):
    before = {name: value.clone() for name, value in styled.clone.state_dict().items()}
    loss = CPLLoss(styled, bank, alpha=0.1, conservatism=1.0)
    scores = loss.scores(torch.tensor([[0, 1]] * 5))
    cpl_loss(scores[:, 0], scores[:, 1]).sum().backward()
    assert styled.members["code"].grad.abs().sum() > 0
    assert [name for name, value in styled.named_parameters() if value.requires_grad] == [
        "members.code"
    ]
    after = styled.clone.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())


def test_codes_are_kept_in_the_box_of_the_data(styled):
    styled.members.data["code"].fill_(100.0)
    styled.constrain_()
    assert torch.equal(styled.members.data["code"], styled.clone.high.expand(5, -1))
    styled.members.data["code"].fill_(-100.0)
    styled.constrain_()
    assert torch.equal(styled.members.data["code"], styled.clone.low.expand(5, -1))


def test_children_copy_their_parents(styled):
    codes = styled.members.data["code"].clone()
    styled.replace_(torch.tensor([4, 4, 0, 1, 2]))
    assert torch.equal(styled.members.data["code"], codes[[4, 4, 0, 1, 2]])
    copy = styled.subset([1])
    copy.members.data["code"].zero_()
    assert torch.equal(styled.members.data["code"][1], codes[4])


def test_codes_must_fit(clone):
    for codes in (torch.zeros(0, 2), torch.zeros(3, 1), torch.zeros(2)):
        with pytest.raises(ValueError, match=r"codes must have shape \[members, 2\]"):
            StyledPopulation(clone, codes)


def test_a_clone_without_weights_is_built_from_its_sizes():
    clone = StyleClone(SPEC, torch.zeros(4, 3))
    seen, told, bias = clone.first_layer()
    assert (seen.shape, told.shape, bias.shape) == ((16, 2), (16, 3), (16,))


def test_questions_find_the_style_over_the_continuous_code(clone, bank):
    """Somebody who likes weak actions is asked five questions over codes drawn from the data."""
    generator = torch.Generator().manual_seed(0)
    policies = PolicySet(StyledPopulation.of_data(clone, 64, generator=generator), alpha=0.5)
    pairs, replies = [], []
    for _ in range(5):
        answers = None
        if pairs:
            said = {"pair": torch.stack(pairs), "answer": torch.tensor(replies)}
            answers = TensorDict(said, [len(pairs)])
        question = policies.next_question(bank, answers, enough=2.0, generator=generator)
        pairs.append(question.pair)
        first, second = question.pair.tolist()
        replies.append(0 if first % 2 < second % 2 else 1 if second % 2 < first % 2 else 2)
    said = {"pair": torch.stack(pairs), "answer": torch.tensor(replies)}
    member = policies.cater(bank, TensorDict(said, [5])).member
    seen = torch.tensor([[0.6, 1.0], [1.2, 1.0]])
    action = policies.act(seen, member=member).squeeze(-1)
    assert (action < 1.5 * seen[:, 0]).all(), "nearer to once than to twice the first coordinate"
