"""Runs in an object store: attempts at them there, and how they come here."""
