"""One colour for each learner, the studio's own."""

from tom.learners import LEARNERS

LEARNER_COLOURS = {name: entry.colour for name, entry in LEARNERS.items() if entry.colour}
NEUTRAL = "#8a92a3"
TEXT = "#1c2330"


def learner_colour(learner: str) -> str:
    """The colour of a learner; a neutral one where it has none of its own."""
    return LEARNER_COLOURS.get(learner, NEUTRAL)
