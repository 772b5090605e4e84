"""One colour for each learner, the studio's own."""

LEARNER_COLOURS = {
    "mle": "#2b6fe0",
    "pmac": "#0c8577",
    "tom": "#c8441c",
    "vagram": "#e056c0",
    "vagram-ensemble": "#bd8d12",
}
NEUTRAL = "#8a92a3"
TEXT = "#1c2330"


def learner_colour(learner: str) -> str:
    """The colour of a learner; a neutral one where it has none of its own."""
    return LEARNER_COLOURS.get(learner, NEUTRAL)
