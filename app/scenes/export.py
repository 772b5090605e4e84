"""Road-and-rocks as one self-contained HTML file with playing fits and driving cars."""

from collections.abc import Sequence

import viser
from viser.infra import StateSerializer

from app.data.road import Picture
from app.scenes import road
from app.scenes.road import RoadScene
from app.scenes.road_frame import LAYERS
from app.scenes.stage import light, sky
from app.scenes.words import fix
from app.theme import Mode
from tom.machine.address import free_port

HERE = "127.0.0.1"
FRAME_S = 0.1
STRIDE = 2
"""steps of the task from one frame to the next"""
REST_S = 1.0
"""how long a fit is shown after the cars have arrived"""


def as_html(fits: Sequence[Sequence[Picture]], mode: Mode, called: Sequence[str] = ()) -> str:
    """The pictures of R runs at F fits, (F, R), as a self-contained page.

    `called`: a name for each run (R,), by default its learner's.

    Its timeline shows the fits one after another; in each the cars drive their whole way. It is
    made by a temporary viser server in this process.
    """
    server = viser.ViserServer(HERE, free_port(HERE), verbose=False)
    try:
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        light(server.scene, mode, front=0.5)
        server.scene.world_axes.visible = False
        camera = server.initial_camera
        camera.position, camera.look_at = road.view(len(fits[0]), camera.fov)
        sky(server.scene, mode)
        names = called or [""] * len(fits[0])
        scenes = [
            RoadScene(server.scene, picture, mode, str(i), road.place(i), name)
            for i, (picture, name) in enumerate(zip(fits[0], names, strict=True))
        ]
        serializer = _record(server, scenes, fits)
        return serializer.as_html(dark_mode=mode == "dark")
    finally:
        server.stop()


def _record(
    server: viser.ViserServer,
    scenes: Sequence[RoadScene],
    fits: Sequence[Sequence[Picture]],
) -> StateSerializer:
    shown = {name: on for name, _, on in LAYERS}
    serializer = None
    for number, pictures in enumerate(fits):
        for each, picture in zip(scenes, pictures, strict=True):
            if number:
                each.update(picture)
            each.show(shown)
            for words in each.words:
                fix(server.scene, words)
        serializer = serializer or server.get_scene_serializer()
        for step in range(0, max(each.longest for each in scenes) + STRIDE, STRIDE):
            for each in scenes:
                each.drive(step)
            serializer.insert_sleep(FRAME_S)
        serializer.insert_sleep(REST_S)
    assert serializer is not None, "there is a fit"
    return serializer
