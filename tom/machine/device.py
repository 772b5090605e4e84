"""The device that a training runs on."""

import torch

from tom.errors import UserError


def require_device(device: str) -> None:
    """Raises UserError if torch does not know `device` or cannot use it here."""
    try:
        kind, index = torch.device(device).type, torch.device(device).index
    except RuntimeError:
        kind, index = "", None
    if kind not in ("cpu", "cuda"):
        raise UserError(f"--device {device}: must be cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        raise UserError(f"--device {device}: torch finds no CUDA GPU here: give --device cpu")
    if kind == "cuda" and index is not None and index >= torch.cuda.device_count():
        raise UserError(f"--device {device}: the last one here is {torch.cuda.device_count() - 1}")
