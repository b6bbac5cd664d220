"""Features of texts: words and length by scikit-learn, or a language model from a local folder.

Nothing is downloaded: a model is a folder that is there, as Hugging Face transformers writes it.
"""

import hashlib
import importlib.util
import json
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from popl_rl.locks import locked
from popl_rl.manifest import read_json
from popl_rl.processes import Workers

__all__ = ["FeatureCache", "language_model_features", "pool", "tfidf_features"]

Features = npt.NDArray[np.float32]


def tfidf_features(
    texts: Sequence[str], *, components: int = 31, least: int = 2, seed: int = 0
) -> Features:
    """Directions of tf–idf and the logarithm of the length, for machines without a language model.

    Latent semantic analysis (Deerwester et al., 1990): weights of words, sublinear in their counts,
    reduced by a truncated singular value decomposition.

    Args:
        texts: N texts.
        components: Directions to keep at most.
        least: Texts that a word must be in to count.
        seed: Seed of the decomposition.

    Returns:
        ``[N, F]``, each feature with mean 0 and standard deviation 1; the last is the length.

    Raises:
        ValueError: If scikit-learn is missing, there are fewer than three texts, or no word is in
            ``least`` of them.
    """
    _need("sklearn", "scikit-learn")
    from sklearn.decomposition import TruncatedSVD
    from sklearn.feature_extraction.text import TfidfVectorizer

    if len(texts) < 3:
        raise ValueError(f"texts must be three or more, got {len(texts)}")
    try:
        words = TfidfVectorizer(sublinear_tf=True, min_df=least).fit_transform(texts)
    except ValueError as error:
        raise ValueError(f"texts cannot be read as words ({error}); lower least") from error
    length = np.log1p([[len(text)] for text in texts])
    count = min(components, min(words.shape) - 1)
    parts = [length]
    if count >= 1:
        parts.insert(0, TruncatedSVD(count, random_state=seed).fit_transform(words))
    return _standard(np.concatenate(parts, 1))


def language_model_features(
    texts: Sequence[str],
    folder: Path,
    *,
    pooling: Literal["mean", "last"] = "mean",
    cache: Path | None = None,
    batch_size: int = 32,
    longest: int = 512,
    device: str | None = None,
    standardise: bool = True,
    workers: Workers | None = None,
    progress: Callable[[int], None] | None = None,
) -> Features:
    """Hidden states of a language model, frozen, of each text.

    Texts are put into batches by length. What has been worked out is kept in ``cache`` by the
    content of the text and of the model's files, so that a killed run goes on where it stopped.

    Args:
        texts: N texts; equal ones are worked out once.
        folder: Model and tokenizer, as ``save_pretrained`` of transformers writes them.
        pooling: ``"mean"`` of the last layer's states over the tokens, as sentence encoders are
            trained; or the ``"last"`` token's, as reward heads on causal models read.
        cache: Folder to keep features in; None for nowhere.
        batch_size: Texts in a batch.
        longest: Tokens of a text that are read: its last ones with ``"last"``, else its first.
        device: Where to run; a GPU if there is one, with bfloat16, if None.
        standardise: Give each feature mean 0 and standard deviation 1 over the texts.
        workers: Processes that read batches side by side, each with a model of its own; this one
            if None. Results are the same to the bit with as many torch threads in each.
        progress: Called with the number of texts done so far.

    Returns:
        ``[N, F]``.

    Raises:
        ValueError: If transformers is missing, ``folder`` holds no model, or ``pooling`` is off.
    """
    _need("transformers", "transformers")
    if pooling not in ("mean", "last"):
        raise ValueError(f"pooling must be 'mean' or 'last', got {pooling!r}")
    if not (folder / "config.json").is_file():
        raise ValueError(
            f"{folder} must be the folder of a language model (config.json, weights, tokenizer); "
            "nothing is downloaded, so put it there before"
        )
    where = device or ("cuda" if torch.cuda.is_available() else "cpu")
    kept = FeatureCache(cache, _digest(folder, pooling, longest))
    different = list(dict.fromkeys(texts))
    missing = [text for text in different if text not in kept]
    if missing:
        order = sorted(missing, key=len, reverse=True)  # memory runs out at once or never
        batches = [order[start : start + batch_size] for start in range(0, len(order), batch_size)]
        done = len(different) - len(missing)
        found = _read_batches(batches, (folder, pooling, longest, where), workers)
        for batch, rows in zip(batches, found, strict=True):
            kept.add(batch, rows)
            done += len(batch)
            if progress is not None:
                progress(done)
    features = np.stack([kept[text] for text in texts])
    return _standard(features) if standardise else features


def _read_batches(
    batches: Sequence[Sequence[str]],
    model: tuple[Path, Literal["mean", "last"], int, str],
    workers: Workers | None,
) -> Iterator[Features]:
    """Features of each batch in turn, from this process or from workers."""
    if workers is None:
        own = _Model(*model)
        yield from map(own, batches)
        return
    asked = [
        workers.submit(number % len(workers), _read_batch, model, batch)
        for number, batch in enumerate(batches)
    ]
    for reply in asked:
        yield reply.result()


def _read_batch(
    model: tuple[Path, Literal["mean", "last"], int, str], batch: Sequence[str]
) -> Features:
    """Features of a batch in a worker, which loads the model once."""
    features: Features = _loaded(*model)(batch)
    return features


@cache
def _loaded(folder: Path, pooling: Literal["mean", "last"], longest: int, device: str) -> "_Model":
    return _Model(folder, pooling, longest, device)


class FeatureCache:
    """Features by the content of texts, in memory and, if there is a folder, on disk.

    On disk it is two files, appended to in turn: rows of float32 numbers, read as a memory map, and
    then the digests of their texts. What was cut off between the two is dropped.

    Args:
        folder: Where to keep them; None for memory alone.
        name: What the features depend on besides the text.
    """

    def __init__(self, folder: Path | None, name: str) -> None:
        self.path = None if folder is None else folder / f"features-{name[:16]}"
        self.rows: dict[str, Features] = {}
        if self.path is not None:
            self.path.mkdir(parents=True, exist_ok=True)
            with locked(self.path):
                self._load(self.path)

    def _load(self, path: Path) -> None:
        keys = (path / "texts.txt").read_text().split() if (path / "texts.txt").is_file() else []
        about = path / "about.json"
        if not keys or not about.is_file():
            return
        width = int(read_json(about, cure=f"remove {path} to read the texts again")["features"])
        size = (path / "rows.float32").stat().st_size // (4 * width)
        count = min(len(keys), size)
        held = np.memmap(path / "rows.float32", np.float32, "r", shape=(count, width))
        self.rows = dict(zip(keys[:count], held, strict=True))

    def __contains__(self, text: str) -> bool:
        return _key(text) in self.rows

    def __getitem__(self, text: str) -> Features:
        return self.rows[_key(text)]

    def add(self, texts: Sequence[str], features: Features) -> None:
        """Keep the features ``[B, F]`` of some texts."""
        keys = [_key(text) for text in texts]
        self.rows.update(zip(keys, features, strict=True))
        if self.path is None:
            return
        with locked(self.path):
            about, rows, names = (
                self.path / name for name in ("about.json", "rows.float32", "texts.txt")
            )
            about.write_text(json.dumps({"features": features.shape[1]}))
            done = len(names.read_text().split()) if names.is_file() else 0
            with rows.open("ab") as file:
                file.truncate(done * 4 * features.shape[1])
            with rows.open("ab") as file:
                file.write(np.ascontiguousarray(features, np.float32).tobytes())
            with names.open("a") as file:
                file.write("".join(f"{key}\n" for key in keys))


def pool(states: Tensor, mask: Tensor, pooling: Literal["mean", "last"]) -> Tensor:
    """One vector for each text.

    Args:
        states: Hidden states of the tokens, ``[B, L, F]``.
        mask: Which tokens there are, ``[B, L]``.
        pooling: ``"mean"`` over the tokens there are, or the ``"last"`` of them.

    Returns:
        ``[B, F]``.
    """
    if pooling == "mean":
        weight = mask.unsqueeze(-1).to(states.dtype)
        return (states * weight).sum(1) / weight.sum(1).clamp(min=1)
    place = torch.arange(mask.shape[1], device=mask.device)
    last = (mask * place).argmax(1)
    return states[torch.arange(len(states), device=states.device), last]


class _Model:
    """A language model that turns batches of texts into features."""

    def __init__(
        self, folder: Path, pooling: Literal["mean", "last"], longest: int, device: str
    ) -> None:
        from transformers import AutoModel, AutoTokenizer

        side = "left" if pooling == "last" else "right"
        options: dict[str, Any] = {"local_files_only": True}
        try:
            self.tokenizer = AutoTokenizer.from_pretrained(folder, truncation_side=side, **options)
            dtype = torch.bfloat16 if device.startswith("cuda") else torch.float32
            self.model = AutoModel.from_pretrained(folder, dtype=dtype, **options)
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(f"{folder} is not readable as a language model: {error}") from error
        if self.tokenizer.pad_token is None:
            self.tokenizer.pad_token = self.tokenizer.eos_token
        self.model.eval().to(device)
        self.pooling, self.device = pooling, device
        most = getattr(self.model.config, "max_position_embeddings", longest)
        self.longest = min(longest, int(most))

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Features:
        batch = self.tokenizer(
            list(texts),
            return_tensors="pt",
            padding=True,
            truncation=True,
            max_length=self.longest,
        ).to(self.device)
        states = self.model(**batch).last_hidden_state
        pooled = pool(states, batch["attention_mask"], self.pooling)
        found: Features = pooled.float().cpu().numpy()
        return found


def _key(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _digest(folder: Path, pooling: str, longest: int) -> str:
    """Digest of all that features depend on besides the text."""
    digest = hashlib.sha256(f"{pooling}/{longest}".encode())
    for path in sorted(folder.iterdir()):
        if path.suffix in (".json", ".txt", ".safetensors", ".model"):
            digest.update(path.name.encode())
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _standard(features: npt.NDArray[Any]) -> Features:
    spread = features.std(0)
    found: Features = ((features - features.mean(0)) / np.where(spread > 1e-9, spread, 1)).astype(
        np.float32
    )
    return found


def _need(module: str, package: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise ValueError(
            f"features of texts need the package {package}, which is not installed: "
            "pip install 'popl_rl[text]'"
        )
