"""The reader's own files that the documentation takes for granted: models and bags."""

from dataclasses import replace
from importlib.metadata import files
from pathlib import Path

from payload_arm import payload_arm_log, write_payload_bag
from random_logs import LogPlan, random_streams, write_bag

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

CAD_ERROR = 25.0  # percent


def write_inaccurate(source: Path, path: Path, seed: int) -> None:
    """Write a copy of a URDF whose links differ by up to 25 %, and are physically possible."""
    parameters = ParameterSet(load_model(source))
    drawn = draw_prior(parameters, "consistent", CAD_ERROR, seed)
    path.write_text(urdf_text(parameters.apply(drawn.mean), source))


def packaged_urdf(name: str) -> Path:
    """Return a file of example-robot-data, which its wheel puts outside of any package."""
    (found,) = (each for each in files("example-robot-data") or () if each.name == name)
    return Path(str(found.locate()))


def ur5_urdf() -> Path:
    """Return the UR5 of example-robot-data."""
    return packaged_urdf("ur5_robot.urdf")


def write_arm(folder: Path) -> None:
    """Write ``my_arm.urdf`` and two bags of a UR5 with friction that its file does not state.

    In ``payload_bag`` the arm carries a payload behind a wrist sensor.
    """
    model = load_model(ur5_urdf())
    joints = tuple(
        replace(joint, damping=2.0 - 0.25 * index, friction_loss=3.0 - 0.4 * index)
        for index, joint in enumerate(model.joints)
    )
    robot = replace(model, joints=joints)
    for name, count, seed in (("arm_bag", 10_000, 3), ("other_arm_bag", 8_500, 9)):
        plan = LogPlan(rate=250.0, count=count)
        write_bag(random_streams(robot, plan, seed), folder / name)
    lifted = payload_arm_log(robot, "tool0", seconds=30.0)
    write_payload_bag(lifted, robot, "tool0", folder / "payload_bag")
    write_inaccurate(ur5_urdf(), folder / "my_arm.urdf", seed=4)
