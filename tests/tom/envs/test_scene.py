import mujoco
import numpy as np
import pytest

from tom.envs import ENVS, scene

mj = scene._mj


@pytest.mark.parametrize("env", list(ENVS))
def test_geometry_is_where_mujoco_itself_puts_it(env: str):
    model = scene.model(env).mj
    qpos = model.qpos0 + np.random.default_rng(0).normal(0, 0.3, (5, model.nq))
    drawn = scene.geometry(model, qpos)
    kinds = {scene.CAPSULE: drawn.capsules, scene.SPHERE: drawn.ellipsoids}
    data = mj.MjData(model)
    for frame, position in enumerate(qpos):
        data.qpos[:] = position
        mj.mj_forward(model, data)
        np.testing.assert_allclose(drawn.root[frame], data.xpos[1], atol=1e-5)
        for kind, shape in kinds.items():
            for k, geom in enumerate(np.flatnonzero(model.geom_type == kind)):
                rotation = data.geom_xmat[geom].reshape(3, 3)
                center = data.geom_xpos[geom]
                np.testing.assert_allclose(shape.center[frame, k], center, atol=1e-5)
                if kind == scene.CAPSULE:
                    end = center - rotation[:, 2] * model.geom_size[geom, 1]
                    np.testing.assert_allclose(shape.capsule_end[frame, k], end, atol=1e-5)
                x, y, z, w = shape.quaternion[frame, k].astype(float)
                back = np.zeros(9)
                mujoco.mju_quat2Mat(back, np.array([w, x, y, z]))  # pyright: ignore
                np.testing.assert_allclose(back.reshape(3, 3), rotation, atol=1e-5)
