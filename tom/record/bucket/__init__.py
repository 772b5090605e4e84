"""Runs in an object store: how they are written there and fetched from there."""
