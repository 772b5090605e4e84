"""The trainings that run now or have just ended, with their progress, and how to stop them."""

import time

import streamlit as st

from app import session
from app.data import readers
from app.parts import start
from app.parts.cards import cards
from tom.record.reader import RunReader

REFRESH_S = 2
"""seconds between two drawings while a run trains, or one that was started here has not begun"""
RECENT_S, MOST = 900, 6
"""seconds for which a run that has ended is still shown, and the number of those that are"""


def draw() -> None:
    """How to start one, and a card for each of them."""
    start.panel()
    runs = readers.listing(session.links().store).runs
    waits = any(run.status.alive for run in runs) or start.waits(runs)
    st.fragment(_cards, run_every=REFRESH_S if waits else None)()


def _cards() -> None:
    runs = readers.listing(session.links().store).runs
    start.failures(runs)
    alive = [run for run in runs if run.status.alive]
    ended = [run for run in runs if just_ended(run)][:MOST]
    if alive or ended:
        cards([*alive, *ended], runs)


def just_ended(run: RunReader) -> bool:
    """Whether a run has ended a short while ago."""
    recent = time.time() - run.status.heartbeat < RECENT_S
    return recent and not run.status.alive and not run.small_copy
