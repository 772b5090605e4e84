"""The buffer as a map with linked histograms, drawn and filtered in the browser.

Arrays come over HTTP in binary, once (`app.data.cache`); what is chosen comes back when the hand
stops. Its script is three files: `rows.js` (codes and filters), `draw.js` (canvases) and `map.js`,
`hands.js` (the part itself).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from app import parts

SELECTOR = ".buffer-map"
TOOLS = {
    "lasso": "draw around rows to choose them",
    "box": "draw a box to choose rows",
    "move": "drag to move; the wheel zooms, a double click shows all",
    "zoom": "draw a box to zoom into",
}
_TOOLS = "".join(
    f'<button type="button" data-tool="{tool}" title="{words}">{tool.title()}</button>'
    for tool, words in TOOLS.items()
)
_HTML = f"""<div class="buffer-map">
      <p class="map-sentence" aria-live="polite"></p>
      <div class="map-bar"><div class="map-presets" role="group" aria-label="Choose rows"></div>
        <dl class="map-numbers"></dl></div>
      <p class="map-failed" role="alert" hidden></p>
      <div class="map-body">
        <div class="map-view">
          <div class="map-bar">
            <div class="map-tools" role="group" aria-label="Pointer">{_TOOLS}</div>
            <label>Colour <select class="map-colour"></select></label></div>
          <div class="map-frame"><canvas class="map-cells"></canvas>
            <canvas class="map-over" tabindex="0" role="img"
              aria-label="The buffer's rows; arrows move, plus and minus zoom, 0 shows all, Escape
              chooses everything"></canvas>
            <span class="map-x"></span><span class="map-y"></span>
            <div class="map-tip" hidden></div></div>
          <div class="map-legend"><b></b><i></i><em></em>
            <div><span></span><span></span><span></span></div></div>
          <div class="map-strip" hidden><p></p><canvas></canvas></div>
        </div>
        <div class="map-side"><p class="map-key">Grey: all rows. Filled: the chosen ones. Line:
            where the weight lies. Drag in any to choose.</p>
          <div class="map-hists"></div><button type="button" class="map-more" hidden></button></div>
      </div></div>"""


def draw(
    given: Mapping[str, Any],
    step: int,
    where: Sequence[str],
    outline: Sequence[str],
    colour: str,
    *,
    chosen: Callable[[list[str], list[str]], None],
    picked: Callable[[int], None],
    coloured: Callable[[str], None],
) -> None:
    """Show the map at a `step` of the timeline, with the selection of the address.

    `chosen` is called with the words of a new selection, `picked` with the recorded number of a
    clicked row, `coloured` with what cells are coloured by: before the page is drawn again.
    """
    data = {
        "given": given, "step": step, "where": list(where), "outline": list(outline),
        "colour": colour,
    }  # fmt: skip
    parts.draw(
        "map", _HTML, "buffer map", data, scripts=("rows", "draw", "map", "hands"),
        chosen=lambda it: chosen(it["where"], it["outline"]), row=lambda row: picked(int(row)),
        colour=coloured,
    )  # fmt: skip
