"""The record of a training loop of the user's own, and live weights of its buffer.

`tom.record`, `tom.weigh_live` and `tom runs import`: docs/your-own-loop.md. The loop's rows,
metrics, weights, policies and replays become a run folder like those of our trainings.
"""
