"""The record of a training loop of the user's own: docs/your-own-loop.md."""
