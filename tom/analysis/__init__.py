"""What finished runs and recorded data are asked: weights, models, statistics."""
