"""Texts that were read become items with features."""

from pathlib import Path
from typing import Literal

from popl_rl.data.readers.imported import Imported
from popl_rl.data.readers.items import features_as_segments
from popl_rl.experiments.progress import Progress
from popl_rl.models.text_features import language_model_features, tfidf_features
from popl_rl.processes import Workers

__all__ = ["encoded"]


def encoded(
    data: Imported,
    encoder: str,
    *,
    pooling: Literal["mean", "last"] = "mean",
    cache: Path | None = None,
    workers: Workers | None = None,
) -> Imported:
    """The same preferences over items with features of their texts.

    Args:
        data: What a reader found; with texts.
        encoder: ``"tfidf"``, or the folder of a language model.
        pooling: How a language model's states become one vector.
        cache: Folder in which a language model's features are kept.
        workers: Processes in which a language model reads; this one if None.

    Raises:
        ValueError: If there are no texts, or as the encoders.
    """
    texts = data.names.texts
    if not texts:
        raise ValueError(
            f"encode={encoder} needs texts, and the items have none; name their column by text="
        )
    if encoder == "tfidf":
        features = tfidf_features(texts)
    else:
        with Progress("texts", total=len(set(texts))) as progress:
            features = language_model_features(
                texts,
                Path(encoder),
                pooling=pooling,
                cache=cache,
                workers=workers,
                progress=progress.update,
            )
    return data._replace(segments=features_as_segments(features))
