"""Named tensors with metadata in safetensors files, protected by a checksum."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ddco_pyro.data.files import Damaged, whole_file


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors and text metadata with a checksum, whole or not at all; equal contents: equal bytes."""
    checked = {**metadata, CHECKSUM: digest_of(tensors, metadata)}
    content = save({name: value.contiguous() for name, value in tensors.items()}, checked)
    with whole_file(path) as temporary:
        temporary.write_bytes(_metadata_in_order(content))


def _metadata_in_order(content: bytes) -> bytes:
    """Contents with sorted metadata, which safetensors writes in random order.

    The header is JSON after its own length, padded to 8 bytes.
    """
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header.get("__metadata__", {}).items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[end:]


CHECKSUM = "sha256"


def digest_of(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """SHA-256 of names, types, shapes, bytes and metadata."""
    digest = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        digest.update(json.dumps([name, str(value.dtype), list(value.shape)]).encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_tensors(path: Path, remedy: str = "write it again") -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file; the checksum is optional.

    :param remedy: what the user can do about a damaged file.
    :raises Damaged: the file cannot be read, or its contents do not match the checksum.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = dict(file.metadata() or {})
    except (SafetensorError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise Damaged(path, " ".join(str(error).split()), remedy) from error
    known = metadata.pop(CHECKSUM, None)
    if known is not None and known != digest_of(tensors, metadata):
        raise Damaged(path, "its contents are not what was written", remedy)
    return tensors, metadata
