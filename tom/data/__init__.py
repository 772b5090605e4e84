"""Transitions and the buffers that hold them."""

from tom.data.transitions import Transitions

__all__ = ["Transitions"]
