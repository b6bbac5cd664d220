"""Features of texts: what they keep, and that nothing is worked out twice."""

import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.models.text_features import (
    FeatureCache,
    language_model_features,
    pool,
    tfidf_features,
)

TEXTS = ["cats like fish", "cats like milk and fish", "dogs like bones", "dogs", "fish like milk"]


def test_length_is_a_feature_and_all_are_standard():
    features = tfidf_features(TEXTS, components=2)
    assert features.shape == (5, 3)
    np.testing.assert_allclose(features.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(features.std(0), 1, atol=1e-5)
    assert features[:, -1].argsort().tolist() == np.argsort([len(t) for t in TEXTS]).tolist()


def test_texts_without_words_are_refused():
    with pytest.raises(ValueError, match="texts must be three or more, got 2"):
        tfidf_features(TEXTS[:2])
    with pytest.raises(ValueError, match="cannot be read as words"):
        tfidf_features(["a b c", "d e f", "g h i"])


def test_pooling_by_hand():
    states = torch.tensor([[[1.0], [3.0], [100.0]], [[2.0], [4.0], [6.0]]])
    mask = torch.tensor([[1, 1, 0], [1, 1, 1]])
    assert pool(states, mask, "mean").tolist() == [[2], [4]]
    assert pool(states, mask, "last").tolist() == [[3], [6]]


@settings(deadline=None)
@given(st.lists(st.text(max_size=5), min_size=1, max_size=6, unique=True))
def test_a_cache_gives_back_what_it_was_given(texts):
    cache = FeatureCache(None, "x")
    features = np.arange(2.0 * len(texts), dtype="f4").reshape(-1, 2)
    cache.add(texts, features)
    for text, row in zip(texts, features, strict=True):
        assert cache[text].tolist() == row.tolist()


def test_a_cache_on_disk_is_read_again_and_survives_a_cut(tmp_path):
    FeatureCache(tmp_path, "one").add(["a", "b"], np.array([[1, 2], [3, 4]], "f4"))
    assert FeatureCache(tmp_path, "one")["b"].tolist() == [3, 4]
    assert "a" not in FeatureCache(tmp_path, "two")
    # Killed between the numbers and the names: what has no name is written over.
    rows = next(tmp_path.glob("features-one")) / "rows.float32"
    rows.write_bytes(rows.read_bytes() + b"\0" * 5)
    again = FeatureCache(tmp_path, "one")
    again.add(["c"], np.array([[5, 6]], "f4"))
    last = FeatureCache(tmp_path, "one")
    assert [last[text].tolist() for text in "abc"] == [[1, 2], [3, 4], [5, 6]]


@pytest.fixture(scope="module")
def model_folder(tmp_path_factory):
    """A language model of a few numbers, with random weights."""
    transformers = pytest.importorskip("transformers")
    tokenizers = pytest.importorskip("tokenizers")
    folder = tmp_path_factory.mktemp("model")
    words = {"[PAD]": 0, "[UNK]": 1} | {
        word: place for place, word in enumerate(sorted(set(" ".join(TEXTS).split())), 2)
    }
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel(words, "[UNK]"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="[PAD]", unk_token="[UNK]"
    ).save_pretrained(folder)
    torch.manual_seed(0)
    config = transformers.BertConfig(
        vocab_size=len(words),
        hidden_size=8,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=8,
        max_position_embeddings=16,
    )
    transformers.BertModel(config).save_pretrained(folder)
    return folder


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_batches_and_padding_change_nothing(model_folder):
    options = {"standardise": False, "device": "cpu"}
    together = language_model_features(TEXTS, model_folder, batch_size=5, **options)
    alone = language_model_features(TEXTS, model_folder, batch_size=1, **options)
    assert together.shape == (5, 8)
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
    standard = language_model_features(TEXTS, model_folder, device="cpu")
    np.testing.assert_allclose(standard.std(0), 1, rtol=1e-4)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_what_is_in_the_cache_is_not_worked_out_again(model_folder, tmp_path, monkeypatch):
    options = {"cache": tmp_path, "device": "cpu", "standardise": False}
    done = []
    first = language_model_features(TEXTS[:3], model_folder, progress=done.append, **options)
    language_model_features([*TEXTS, TEXTS[0]], model_folder, progress=done.append, **options)
    assert done == [3, 5]
    monkeypatch.setattr("popl_rl.models.text_features._Model", None)
    again = language_model_features(TEXTS[:3], model_folder, **options)
    np.testing.assert_array_equal(first, again)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_workers_read_the_same(model_folder, tmp_path, workers):
    options = {"batch_size": 2, "device": "cpu"}
    done = []
    alone = language_model_features(TEXTS, model_folder, **options)
    options |= {"cache": tmp_path, "progress": done.append}
    together = language_model_features(TEXTS, model_folder, workers=workers, **options)
    assert np.array_equal(alone, together)
    assert done == [2, 4, 5]


def test_what_is_no_model_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="must be the folder of a language model"):
        language_model_features(TEXTS, tmp_path)
    with pytest.raises(ValueError, match="pooling must be 'mean' or 'last', got 'max'"):
        language_model_features(TEXTS, tmp_path, pooling="max")
    monkeypatch.setitem(sys.modules, "sklearn", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(ValueError, match=r"need the package scikit-learn.*popl_rl\[text\]"):
        tfidf_features(TEXTS)
