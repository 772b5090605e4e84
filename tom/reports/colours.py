"""One colour for each learner, as in the studio."""

from tom.learners import LEARNERS

LEARNER_COLOURS = {name: entry.colour for name, entry in LEARNERS.items() if entry.colour}
NEUTRAL = "#8a92a3"
TEXT = "#1c2330"


def learner_colour(learner: str) -> str:
    """The colour of a learner; a neutral one if it has none."""
    entry = LEARNERS.get(learner)
    return entry.colour if entry and entry.colour else NEUTRAL
