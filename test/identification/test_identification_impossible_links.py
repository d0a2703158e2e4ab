"""A model file with a link that no body can be is identified as one that can."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.identification.prior_options import describe_impossible_links
from symbid_ros.model.inertia import is_consistent, phi_from_com
from symbid_ros.model.load import load_model

BAD = 2
LINK = """<link name="{name}"><inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>
<inertia ixx="{0}" iyy="{1}" izz="{2}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="j_{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint>"""


@pytest.fixture(scope="module")
def robot():
    return arm()


@pytest.fixture(scope="module")
def stated(robot):
    """The robot with a link whose largest moment exceeds the sum of the others."""
    phi = robot.phi.copy()
    mass, com = phi[BAD, 0], phi[BAD, 1:4] / phi[BAD, 0]
    phi[BAD] = phi_from_com(mass, com, 0.01 * mass * np.diag([3.0, 1.0, 1.0]))
    assert not is_consistent(phi[BAD])
    return robot.with_phi(phi)


def test_the_link_is_named_once_and_its_estimate_is_possible(robot, stated, caplog):
    name = stated.link_names[BAD]
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    estimate = sy.identify(stated, log, no_holdout=True).estimate
    named = [one for one in caplog.messages if "physically impossible" in one]
    assert len(named) == 1
    assert f"link {name} is" in named[0]
    assert estimate.consistent[name]


def load(folder, *links):
    """Return an arm of links, each given as mass and principal moments of inertia."""
    parts, parent = ['<link name="world"/>'], "world"
    for index, (mass, *moments) in enumerate(links):
        name = f"link_{index}"
        parts.append(LINK.format(*moments, name=name, mass=mass))
        parts.append(JOINT.format(parent=parent, child=name))
        parent = name
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    return load_model(path)


@pytest.mark.parametrize(
    ("link", "is_possible"),
    [
        ((2.0, 0.02, 0.02, 0.01), True),
        ((2.0, 0.02, 0.01, 0.01), True),  # a thin plate
        ((2.0, 0.021, 0.01, 0.01), False),
        ((2.0, 0.0, 0.0, 0.0), True),  # a point mass
        ((0.0, 0.0, 0.0, 0.0), True),  # the file says nothing
        ((0.0, 0.02, 0.02, 0.01), False),
    ],
)
def test_links_that_violate_the_triangle_inequality_are_named(tmp_path, link, is_possible):
    model = load(tmp_path, (1.0, 0.01, 0.01, 0.01), link)
    text = describe_impossible_links(model)
    assert (text == "") == is_possible
    assert is_possible or "arm.urdf: link link_1 is physically impossible" in text


def test_several_links_are_one_line(tmp_path):
    bad = (1.0, 0.03, 0.01, 0.01)
    text = describe_impossible_links(load(tmp_path, bad, (1.0, 0.01, 0.01, 0.01), bad))
    assert "links link_0, link_2 are physically impossible" in text
    assert "\n" not in text
