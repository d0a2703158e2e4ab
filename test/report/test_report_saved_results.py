"""Results that are read for a report: their robot is shown as in the user's file."""

from dataclasses import replace

import pytest
from written_results import write_result

from symbid_ros.estimation.estimate_file import load_estimate, write_estimate
from symbid_ros.estimation.provenance import digest
from symbid_ros.model.visual_shapes import visual_shapes
from symbid_ros.report.saved_results import load_result

TRIANGLE = """solid one
facet normal 0 0 1 outer loop vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 endloop endfacet
endsolid one"""
ARM = """<robot name="arm"><link name="base"/>
 <joint name="turn" type="continuous"><parent link="base"/><child link="upper"/></joint>
 <link name="upper"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><geometry><mesh filename="package://my_arm/meshes/upper.stl"/></geometry></visual>
 </link></robot>"""


@pytest.mark.parametrize("is_changed", [False, True])
def test_meshes_are_found_above_the_file_that_was_identified(tmp_path, is_changed):
    """The result lies elsewhere; a file that has changed since may be of another robot."""
    package = tmp_path / "workspace" / "my_arm"
    (package / "meshes").mkdir(parents=True)
    (package / "meshes" / "upper.stl").write_text(TRIANGLE)
    source = package / "arm.urdf"
    source.write_text(ARM)
    folder = tmp_path / "elsewhere" / "result"
    folder.parent.mkdir()
    write_result(folder, source, base="fixed")
    estimate = load_estimate(folder / "estimate.json")
    provenance = replace(estimate.provenance, inputs=(digest(source),))
    estimate = replace(estimate, inputs=(str(source),), provenance=provenance)
    write_estimate(folder / "estimate.json", estimate)
    if is_changed:
        source.write_text(ARM.replace("upper.stl", "other.stl"))
    found = visual_shapes(load_result(folder).parameters.model)
    assert [one.kind for one in found.shapes] == ([] if is_changed else ["mesh"])
