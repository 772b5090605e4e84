"""Film: a run's whole story in a minute on one timeline, on the page and as a file."""

import shlex

import streamlit as st

from app import session, text
from app.data.cache import VersionedCache
from app.parts import address, empty, widgets
from app.parts.scope import Scope
from app.scenes.film import SECONDS, cinema
from app.scenes.film.story import may_be_told, story
from tom.errors import UserError

HEIGHT = 700
LENGTHS = {"15 s": 15.0, "30 s": 30.0, "1 min": SECONDS, "2 min": 120.0}

_STORIES: VersionedCache[dict] = VersionedCache()


def draw(scope: Scope) -> None:
    """A run's film, and the film as a file."""
    store = session.links().store
    run = scope.one(may_be_told, widgets.telling)
    if run is None:
        st.info("No run here has a story yet: it needs two model fits and its buffer (MuJoCo).")
        return
    top = st.columns([6, 2], vertical_alignment="bottom")
    chosen = address.choose_one(
        top[0].segmented_control, "Length", list(LENGTHS), "length", "1 min", required=True
    )
    try:
        with st.spinner("The story is told to the film..."):
            version = run.version("metrics"), run.name  # the film has the name as its title
            told = _STORIES.get(run.path, lambda: story(run), version)
    except UserError as error:
        empty.left_out(run, "buffer")
        st.warning(text.markdown(error))
        return
    film = cinema(told, run.learner, session.mode(), LENGTHS[chosen])
    name = f"{run.run_id}-cinema.html"
    top[1].download_button(
        "One HTML file", film, name, "text/html", key="film", width="stretch",
        icon=":material/download:", on_click="ignore",
        help="it opens without a server and without a network",
    )  # fmt: skip
    st.iframe(film, height=HEIGHT)
    st.caption(
        "A robot and a point of the buffer have the mean weight of the hundredth of the buffer "
        "that they lie in, at every fit. In front: an evaluation of the newest policy kept by "
        "then, at half speed. Space plays and stops, arrows go a second."
    )
    with st.expander("From a terminal", icon=":material/terminal:"):
        words = ["tom", "studio", "--cinema", "film", "--run", run.run_id, "--store", store]
        st.code(shlex.join([*words, "--theme", session.mode()]), language="bash")
        st.caption(
            "Writes cinema.html, cinema.mp4 and a small cinema.webp; needs Chromium. The film's "
            "own button saves the MP4 where the browser can encode: on this machine, or by https."
        )
    empty.left_out(run, "other evaluations")
