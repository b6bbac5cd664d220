"""Digests of what is saved, and JSON that tells if it was changed.

A digest is BLAKE2b of 128 bits. That of tensors goes over names, types, shapes and bytes, whatever
the files that hold them: the same data have the same digest in memory, on a disk and in a link. It
is a check against damage and mix-ups, not against somebody who wants to deceive.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # Imported where it is used: what writes JSON alone need not wait for PyTorch.
    from tensordict import TensorDictBase

__all__ = ["digest_of_bytes", "digest_of_tensors", "read_json", "read_sealed", "sealed"]

_SEAL = "seal"


def digest_of_bytes(content: bytes | memoryview) -> str:
    """Digest of a file's content."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def digest_of_tensors(data: "TensorDictBase") -> dict[str, str]:
    """Digest of each tensor, and of all together under the name ``""``.

    One pass over the bytes, about a second for each GB.

    Args:
        data: TensorDict of any shape, from whichever device; nested names are joined by dots.
    """
    import torch

    found = {}
    for key in sorted(data.keys(True, True), key=str):
        tensor = data[key].detach().cpu().contiguous()
        about = f"{tensor.dtype} {list(tensor.shape)}".encode()
        content = tensor.reshape(-1).view(torch.uint8).numpy() if tensor.numel() else b""
        digest = hashlib.blake2b(about, digest_size=16)
        digest.update(content)
        found[key if isinstance(key, str) else ".".join(key)] = digest.hexdigest()
    found[""] = digest_of_bytes(_canonical(found))
    return found


def sealed(about: Mapping[str, Any]) -> dict[str, Any]:
    """The same entries and a digest of them, by which ``read_sealed`` knows them again."""
    content: dict[str, Any] = json.loads(json.dumps(about))
    return {**content, _SEAL: digest_of_bytes(_canonical(content))}


def read_json(path: Path, *, cure: str) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        cure: What to do if it is damaged, for the message.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged, with its name and the cure.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged, it is no JSON ({error}); {cure}") from error


def read_sealed(path: Path, *, cure: str) -> dict[str, Any]:
    """Read a JSON file that holds what ``sealed`` made.

    Args:
        path: The file.
        cure: What to do if it is damaged, for the message.

    Returns:
        The entries; of a file of an earlier version, which has no seal, with ``"seal": None``.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged or was changed, with its name and the cure.
    """
    content = read_json(path, cure=cure)
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged, it must be a JSON object; {cure}")
    seal = content.pop(_SEAL, None)
    if seal is None:
        return {**content, _SEAL: None}
    if seal != digest_of_bytes(_canonical(content)):
        raise ValueError(f"{path} was changed or damaged after it was written; {cure}")
    return content


def _canonical(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
