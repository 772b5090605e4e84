"""The base of all browser frames of the viser server: panel, scene, light, camera."""

import threading

import viser

from app.scenes.colours import rgb
from app.scenes.control import Clock, Selection
from app.scenes.stage import light
from app.scenes.words import Vector
from app.theme import ACCENT, Mode


class Frame:
    """One connected browser frame that shows one kind of scene."""

    title: str
    """the title of the panel"""
    fill = 0.0
    """brightness of the front light"""
    shadows = False
    """shadows halve the frame rate on a slow machine"""

    def __init__(
        self, client: viser.ClientHandle, store: str, mode: Mode, *, compact: bool = False
    ) -> None:
        self.client = client
        self.store = store
        self.mode: Mode = mode
        self.compact = compact
        self._lock = threading.RLock()
        self._closed = False
        self._dress()
        client.gui.set_panel_label(self.title)
        self._build_panel()
        if compact:
            client.gui.main_panel.minimize()

    def show(self, selection: Selection, *, obey: bool = False) -> None:
        """Show a page's choice; with `obey`, carry out its request too.

        Raises UserError if it cannot be read.
        """
        with self._lock:
            if selection.mode != self.mode:
                self.mode = selection.mode
                self._dress()
                self._mode_changed()
            self._show(selection, obey=obey)

    def close(self) -> None:
        """Clear the scene and the panel for a frame of another kind."""
        with self._lock:
            self._closed = True
            self.client.gui.reset()
            self.client.scene.reset()

    def tick(self, seconds: float) -> None:
        """Advance playback by `seconds`."""
        with self._lock:
            if not self._closed:  # the clock may still tick a frame that was just replaced
                self._tick(seconds)

    def clock(self) -> Clock | None:
        """The state of playback; None if this kind of scene plays nothing."""
        return None

    def look(self, position: Vector, at: Vector) -> None:
        """Set the user's camera."""
        self.client.camera.position = position
        self.client.camera.look_at = at

    def _dress(self) -> None:
        self.client.gui.configure_theme(
            dark_mode=self.mode == "dark",
            show_logo=False,
            show_share_button=False,
            control_width="small",
            brand_color=rgb(ACCENT[self.mode]),
        )
        self.client.scene.configure_default_lights(cast_shadow=self.shadows)
        # No environment map: viser fades in the canvas after its default map is loaded. If another
        # map arrives meanwhile, the scene stays pale until it is opened again.
        self.client.scene.configure_environment_map(None)
        light(self.client.scene, self.mode, self.fill)

    def clear(self) -> None:
        """Remove everything from the scene except the light."""
        self.client.scene.reset()
        light(self.client.scene, self.mode, self.fill)

    def _build_panel(self) -> None:
        raise NotImplementedError

    def _show(self, selection: Selection, *, obey: bool) -> None:
        raise NotImplementedError

    def _mode_changed(self) -> None:
        """Redraw everything that has colours of the old mode."""

    def _tick(self, seconds: float) -> None:
        """Advance playback; by default nothing plays."""
