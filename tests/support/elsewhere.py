"""A device that is not there: tensors that say they are on ``THERE``, have their numbers here, and mix with no others.

What runs on them is what a GPU would be asked to do: an operation with a tensor that was left on the host fails.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

THERE = torch.device("meta")
"""What the double calls itself: a device that torch knows, and that needs no driver."""

MOVES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class Elsewhere(Tensor):
    """A tensor on the double; ``here`` has its numbers."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        facts = {"strides": here.stride(), "storage_offset": here.storage_offset(), "dtype": here.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, here.size(), device=THERE, **facts)

    def __init__(self, here: Tensor) -> None:
        self.here = here

    def __repr__(self) -> str:  # torch's own would ask for numbers
        return f"Elsewhere({self.here!r})"

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


class Device(TorchDispatchMode):
    """While it is active tensors can be moved to ``THERE`` and made there."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


def _run(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, Elsewhere)]
    left = [tensor for tensor in tensors if not isinstance(tensor, Elsewhere) and tensor.dim()]
    if operation not in MOVES and there and left:
        raise AssertionError(f"{operation} mixes devices: one tensor {list(left[0].shape)} is on the host")
    named = kwargs.get("device")
    goes = bool(there) if named is None else torch.device(named) == THERE
    if named is not None:
        kwargs = kwargs | {"device": "cpu"}
    own = {id(tensor.here): tensor for tensor in there}
    args, kwargs = tree_map(lambda leaf: leaf.here if isinstance(leaf, Elsewhere) else leaf, (args, kwargs))

    def back(result: Any) -> Any:
        if not isinstance(result, Tensor) or not goes:
            return result
        return own[id(result)] if id(result) in own else Elsewhere(result)

    return tree_map(back, operation(*args, **kwargs))
