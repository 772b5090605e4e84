"""Checks of a torch file, before and after it is loaded, so that a small one cannot fill memory."""

import os
import zipfile
from collections.abc import Iterator
from typing import IO

import torch


def check_tensors(file: IO[bytes]) -> None:
    """Raises ValueError unless a torch file stores its tensors uncompressed.

    Then loading allocates no more than the file's length. Raises zipfile's errors as well.
    """
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("its parts are packed, which torch never does")
    if sum(member.file_size for member in members) > file.seek(0, os.SEEK_END):
        raise ValueError("its parts are larger than the file")
    file.seek(0)


def check_views(state: object) -> None:
    """Raises ValueError if a loaded tensor has more elements than its storage."""
    for tensor in _tensors(state, set()):
        whole = tensor.layout is torch.strided and not tensor.is_meta and not tensor.is_quantized
        held = tensor.untyped_storage().nbytes() if whole else -1
        if tensor.numel() * tensor.element_size() > held:
            raise ValueError(f"a tensor of {tuple(tensor.shape)} is larger than what it holds")


def _tensors(value: object, seen: set[int]) -> Iterator[torch.Tensor]:
    """Every tensor in nested containers, each container once, because they may be cyclic."""
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, torch.Tensor):
            yield one
        elif isinstance(one, dict | list | tuple | set) and id(one) not in seen:
            seen.add(id(one))
            waiting.extend(one.values() if isinstance(one, dict) else one)
