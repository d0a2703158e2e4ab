"""`symbid init --foxglove`: a layout for the user's own robot."""

import json

import pytest
from documented_robots import ur5_urdf

from symbid_ros.cli.foxglove import MOST_JOINTS, MOST_LINKS, foxglove_layout
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file


def test_a_layout_of_an_arm_plots_its_links_and_joints(symbid_here, tmp_path) -> None:
    file = tmp_path / "layout.json"
    ended = symbid_here("init", "--model", ur5_urdf(), "--foxglove", file)
    assert ended.returncode == 0, ended.stderr
    assert "layout.json" in ended.stdout
    arm = load_model(ur5_urdf())
    panels = json.loads(file.read_text())["configById"]
    joints = [path["label"] for path in panels["Plot!effort_residual"]["paths"]]
    assert joints == list(arm.joint_names)
    assert {path["label"] for path in panels["Plot!mass"]["paths"]} == set(arm.link_names)
    # A fixed base has no wrench residual.
    assert not [name for name in panels if "force" in name or "moment" in name]
    again = symbid_here("init", "--model", ur5_urdf(), "--foxglove", file)
    assert again.returncode == 2
    assert "E551" in again.stderr


@pytest.mark.parametrize("given", [[], ["--bag", "log"], ["--out", "robot.yaml"]])
def test_half_a_robot_file_is_refused(symbid_here, given) -> None:
    ended = symbid_here("init", "--model", ur5_urdf(), *given)
    assert ended.returncode == 2
    assert "--foxglove" in ended.stderr
    assert "E585" in ended.stderr


def test_large_robots_show_their_heaviest_links() -> None:
    model = load_model(config_file("symbitron.xml"))
    panels = foxglove_layout(model)["configById"]
    shown = {path["label"] for path in panels["Plot!mass"]["paths"]}
    masses = dict(zip(model.link_names, model.phi[:, 0], strict=True))
    assert len(shown) == MOST_LINKS
    assert min(masses[link] for link in shown) >= max(
        mass for link, mass in masses.items() if link not in shown
    )
    assert len(panels["Plot!effort_residual"]["paths"]) <= MOST_JOINTS
