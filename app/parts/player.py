"""Playback of an episode: the scene has the clock, the page controls and follows it."""

import streamlit as st

from app import session, text
from app.data.replays import Replay
from app.scenes.control import REAL_TIME, SPEEDS, Clock, ReplayChoice, Wish, clock

PART = "replay"
"""the name of the frame on its page"""
FRAME, SLIDER = "frame", "replay frame"
ASKED = "replay asked"
"""the page's requests: their number, the last one, and its frame"""
NOTHING = (0, "go", 0)


def follow(replay: Replay) -> bool:
    """Follow the scene, which plays or has controls of its own; returns whether it plays.

    A scene that has not yet heard the page's last request is not followed.
    """
    now = _clock()
    if now is None or FRAME not in st.session_state:
        return False
    frame = min(now.frame, replay.episode.length)
    if now.asked == st.session_state.get(ASKED, NOTHING)[0] and frame != st.session_state[FRAME]:
        _show(frame)
        if not now.playing:
            _write(frame)
    return now.playing


def position() -> tuple[int, bool]:
    """The scene's step and whether it plays; the page's wish until the scene has heard it."""
    now, (asked, wish, _) = _clock(), st.session_state.get(ASKED, NOTHING)
    if now is None or now.asked != asked:
        return st.session_state.get(FRAME, 0), now is not None and wish == "play"
    return now.frame, now.playing


def marked(replay: Replay) -> int:
    """The shown step of the episode; the address (`?frame=`) gives the first one."""
    if FRAME not in st.session_state:
        go_to(text.whole(st.query_params.get(FRAME, "")) or 0)
    if st.session_state[FRAME] > replay.episode.length:  # chosen in a longer episode
        go_to(0)
    return int(st.session_state[FRAME])


def go_to(frame: int) -> None:
    """Ask the scene to go to a step."""
    _show(frame)
    _write(frame)
    _ask("go", frame)


def choice(run_id: str, replay: Replay, index: int, horizon: int) -> ReplayChoice:
    """The message for the scene: the episode and the last request."""
    asked, wish, frame = st.session_state.get(ASKED, NOTHING)
    speed = st.session_state.get("replay speed", REAL_TIME)
    ghost, follows = (
        bool(st.session_state.get(name, True)) for name in ("replay ghost", "replay follows")
    )
    return ReplayChoice(
        run_id, replay.step, index, frame, horizon,
        asked=asked, wish=wish, speed=speed, ghost=ghost, follow=follows,
    )  # fmt: skip


def panel(replay: Replay, *, playing: bool) -> None:
    """Below the stage: play or pause, the step, the speed, the ghost, the camera."""
    icon = ":material/pause:" if playing else ":material/play_arrow:"
    row = st.columns([2, 6, 3], vertical_alignment="bottom")
    row[0].button(
        "Pause" if playing else "Play", icon=icon, key="replay play", width="stretch",
        on_click=_toggle, args=(replay.episode.length,),
    )  # fmt: skip
    if st.session_state.get(SLIDER) != st.session_state[FRAME]:  # else it would interrupt a drag
        st.session_state[SLIDER] = st.session_state[FRAME]
    row[1].slider(
        "Step of the episode",
        0,
        replay.episode.length,
        key=SLIDER,
        on_change=lambda: go_to(int(st.session_state[SLIDER])),
    )
    row[2].selectbox("Speed", list(SPEEDS), list(SPEEDS).index(REAL_TIME), key="replay speed")
    row = st.columns(2)
    row[0].toggle("Model's ghost", True, key="replay ghost", disabled=replay.ghost is None)
    row[1].toggle("Camera follows", True, key="replay follows")


def _toggle(last: int) -> None:
    now = _clock()
    if now is not None and now.playing:
        _ask("pause", now.frame)
        _show(now.frame)
        _write(now.frame)
        return
    if st.session_state[FRAME] >= last:
        _show(0)
    _ask("play", st.session_state[FRAME])


def _show(frame: int) -> None:
    st.session_state[FRAME] = frame


def _write(frame: int) -> None:
    """Put a step into the address; the first one only in place of another."""
    if frame or FRAME in st.query_params:
        st.query_params[FRAME] = str(frame)


def _ask(wish: Wish, frame: int) -> None:
    asked = st.session_state.get(ASKED, NOTHING)[0]
    st.session_state[ASKED] = (asked + 1, wish, frame)


def _clock() -> Clock | None:
    """The scene's clock; None also if there is no scene server."""
    links = session.links()
    if not links.folder:
        return None
    try:
        return clock(links.control, f"{session.client()}{PART}")
    except OSError:
        return None
