"""Forces without moments act at the lowest point of a foot that is a ball."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.identification.rows.aligned_log import AlignedLog, joined_segments
from symbid_ros.model.load import load_model
from symbid_ros.signals.log import Log

RADIUS, RATE, SECONDS = 0.03, 200.0, 6.0
LEG = f"""
  <body name="{{name}}_thigh" pos="{{place}} 0"><joint name="{{name}}_hip" axis="1 0 0"/>
   <inertial mass="1" pos="0 0 -0.1" diaginertia="0.01 0.01 0.01"/>
   <body name="{{name}}_shin" pos="0 0 -0.25"><joint name="{{name}}_knee" axis="0 1 0"/>
    <inertial mass="1" pos="0 0 -0.1" diaginertia="0.01 0.01 0.01"/>
    <geom name="{{name}}_ball" type="sphere" size="{RADIUS}" pos="0.01 0 -0.25"/>
    <site name="{{name}}_foot" pos="0.01 0 -0.25" euler="20 30 40"/>
   </body>
  </body>"""
ROBOT = f"""<mujoco><worldbody><body name="trunk"><freejoint/><site name="imu"/>
   <inertial mass="9" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
   {"".join(LEG.format(name=name, place=at) for name, at in (("left", "0 .1"), ("right", "0 -.1")))}
 </body></worldbody></mujoco>"""
FEET = "left_foot", "right_foot"


@pytest.fixture(scope="module")
def turning():
    """Return what joints and IMU of a base read that turns in place, and wrenches (N, 2, 6).

    The wrenches are forces on the balls' lowest points, with their moments about the sites, as
    MuJoCo's kinematics tell.
    """
    time = np.arange(0.0, SECONDS, 1 / RATE)
    wave = np.stack([np.sin((1 + 0.3 * k) * 2.5 * time + k) for k in range(7)], axis=1)
    base = Rotation.from_rotvec(0.3 * wave[:, :3])
    position = 0.5 * wave[:, 3:]
    model = mujoco.MjModel.from_xml_string(ROBOT)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    wrenches = np.empty((len(time), 2, 6))
    for index in range(len(time)):
        data.qpos[3:7] = base[index].as_quat(scalar_first=True)
        data.qpos[7:] = position[index]
        mujoco.mj_kinematics(model, data)
        for foot, name in enumerate(FEET):
            force = rng.normal(size=3) * [20, 20, 5] + [0, 0, 60]
            moment = np.cross([0, 0, -RADIUS], force)
            axes = data.site(name).xmat.reshape(3, 3)
            wrenches[index, foot] = np.concatenate([force @ axes, moment @ axes])
    turn = base[:-1].inv() * base[1:]
    rate = RATE * turn.as_rotvec()
    imu = np.hstack([np.vstack([rate, rate[-1:]]), base.inv().apply([0, 0, 9.81])])
    return time, position, imu, wrenches


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "robot.xml"
    path.write_text(ROBOT)
    return load_model(path)


def aligned(robot, turning, wrenches):
    time, position, imu, _ = turning
    readings = {foot: wrenches[:, index] for index, foot in enumerate(FEET)}
    effort = np.sin(time)[:, None] * np.ones(4)
    log = Log.from_arrays(
        robot, time=time, position=position, effort=effort, imus={"imu": imu}, wrenches=readings
    )
    (segment,) = joined_segments(AlignedLog(log, robot))
    return np.concatenate([segment.wrenches[..., 3:], segment.wrenches[..., :3]], axis=-1)


def test_forces_alone_get_the_moments_of_the_lowest_point(robot, turning):
    *_, measured = turning
    forces = measured.copy()
    forces[..., 3:] = 0.0
    found = aligned(robot, turning, forces)
    np.testing.assert_array_equal(found[..., :3], forces[..., :3])
    size = np.sqrt(np.mean(measured[..., 3:] ** 2))
    assert np.sqrt(np.mean((found - measured) ** 2)) < 0.02 * size


def test_measured_moments_stay(robot, turning):
    *_, measured = turning
    one = measured.copy()
    one[:, 1, 3:] = 0.0
    one[100, 1, 5] = 1e-3
    np.testing.assert_array_equal(aligned(robot, turning, one), one)
