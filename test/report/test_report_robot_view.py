"""The scene against MuJoCo; the view in a browser, and the still picture."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from browser import DESKTOP, PHONE
from documented_robots import ur5_urdf
from drawn_estimates import drawn_estimate
from report_pages import Page

from symbid_ros.model.load import load_model
from symbid_ros.model.rotation import rotation_from_xyzw
from symbid_ros.package_paths import config_file
from symbid_ros.report.palette import link_colour
from symbid_ros.report.robot_scene import RobotScene, robot_scene
from symbid_ros.report.robot_view import RobotView, robot_view
from symbid_ros.report.still_picture import HEIGHT

# Bytes of the view of the package's robot.
LARGEST = 1_500_000


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def posture(model):
    return np.random.default_rng(2).uniform(-0.5, 0.5, len(model.joints))


@pytest.fixture(scope="module")
def scene(model, posture) -> RobotScene:
    return robot_scene(*drawn_estimate(model), posture)


@pytest.fixture(scope="module")
def view(scene) -> RobotView:
    return robot_view(scene)


def write_page(view: RobotView, path: Path) -> Path:
    path.write_text(
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>t</title>'
        '<link rel="icon" href="data:,"><meta name="viewport" content="width=device-width">'
        f"<style>{view.style}</style></head>"
        f"<body>{view.html}<script>{view.script}</script></body></html>",
        encoding="utf-8",
    )
    return path


@pytest.fixture(scope="module")
def page_file(view, tmp_path_factory) -> Path:
    return write_page(view, tmp_path_factory.mktemp("view") / "page.html")


class TestScene:
    def test_centres_of_mass_are_those_of_mujoco(self, model, posture, scene) -> None:
        m = mujoco.MjModel.from_xml_path(model.source)
        data = mujoco.MjData(m)
        data.qpos[7:] = posture
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        base = m.body(model.links[0].name).id
        rotation, origin = data.xmat[base].reshape(3, 3), data.xpos[base]
        for link in scene.links:
            body = m.body(link.name).id
            com = link.rotation @ link.com_after + link.position
            true = rotation.T @ (data.xipos[body] - origin)
            np.testing.assert_allclose(com, true, atol=1e-9)
            # MuJoCo lists the principal moments in the axes of the inertia's own frame.
            squares = link.after.size**2
            moments = link.after.mass * (squares.sum() - squares) / 12
            np.testing.assert_allclose(np.sort(moments), np.sort(m.body_inertia[body]), rtol=1e-6)
        total = rotation.T @ (data.subtree_com[base] - origin)
        np.testing.assert_allclose(scene.com_after, total, atol=1e-9)

    def test_the_json_holds_the_same_poses_and_triangles(self, scene) -> None:
        document = json.loads(json.dumps(scene.document()))
        for link, entry in zip(scene.links, document["links"], strict=True):
            rotation = rotation_from_xyzw(np.array(entry["quaternion"]))
            np.testing.assert_allclose(rotation, link.rotation, atol=1e-5)
            np.testing.assert_allclose(entry["com"]["after"], link.com_after, atol=1e-6)
            np.testing.assert_allclose(entry["after"]["size"], link.after.size, atol=1e-6)
        for mesh, entry in zip(scene.meshes, document["meshes"], strict=True):
            integers = np.frombuffer(base64.b64decode(entry["vertices"]), "<i2").reshape(-1, 3)
            vertices = entry["scale"] * integers + entry["centre"]
            np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-4)
            faces = np.frombuffer(base64.b64decode(entry["faces"]), "<u2").reshape(-1, 3)
            np.testing.assert_array_equal(faces, mesh.faces)

    def test_numbers_state_before_after_and_deviation(self, model, scene) -> None:
        _, estimate = drawn_estimate(model)
        link = scene.links[3]
        place = estimate.names.index(f"{link.name}/m")
        name, before, after = link.numbers[0]
        assert name == "mass, kg"
        assert float(before) == pytest.approx(estimate.prior[place], rel=1e-3)
        value, _, std = after.partition(" ± ")
        assert float(value) == pytest.approx(estimate.value[place], abs=estimate.std[place])
        assert float(std) == pytest.approx(estimate.std[place], rel=0.1)
        assert link.determined == 3

    def test_impossible_inertias_have_no_box_but_a_centre_of_mass(self, model) -> None:
        parameters, estimate = drawn_estimate(model)
        value = estimate.value.copy()
        value[4] = -1.0  # Ixx of the base
        link = robot_scene(parameters, replace(estimate, value=value)).links[0]
        assert link.after is None
        assert link.com_after is not None

    def test_a_fixed_arm_stands_upright(self) -> None:
        arm = robot_scene(*drawn_estimate(load_model(ur5_urdf())))
        np.testing.assert_allclose(arm.up, [0, 0, 1])
        assert {mesh.link for mesh in arm.meshes} == set(range(len(arm.links)))


class TestStillPicture:
    def test_is_a_valid_image_with_all_boxes_and_centres(self, scene, view) -> None:
        page = Page(view.still_svg)
        assert page.elements[0][1]["role"] == "img"
        circles = [attributes for tag, attributes in page.elements if tag == "circle"]
        assert len(circles) == 2 * len(scene.links) + 2
        boxes = [d for d in page.attributes("d") if d.count("M") == d.count("L") == 12]
        assert len(boxes) == 2 * len(scene.links)
        assert len(view.still_svg) < 200_000

    def test_boxes_near_the_robot_are_shown_in_full(self, view) -> None:
        left, top, width, height = map(float, Page(view.still_svg).attributes("viewbox")[0].split())
        boxes = [d for d in Page(view.still_svg).attributes("d") if d.count("L") == 12]
        points = np.array(re.findall(r"[ML](-?\d+) (-?\d+)", "".join(boxes)), dtype=float)
        assert np.all(points >= [left, top])
        assert np.all(points <= [left + width, top + height])

    def test_a_box_much_larger_than_the_robot_does_not_shrink_it_further(self, model) -> None:
        parameters, estimate = drawn_estimate(model)

        def bodies(moment: float) -> tuple[list[str], float]:
            value = estimate.value.copy()
            value[4:10] = [moment, 0, 0, moment, 0, moment]
            svg = robot_view(robot_scene(parameters, replace(estimate, value=value))).still_svg
            shapes = re.findall(r'<path fill="[^"]+" stroke[^>]+>', svg)
            heights = re.findall(r"M-?\d+ (-?\d+)", "".join(shapes))
            return shapes, float(np.ptp(np.array(heights, dtype=float)))

        shapes, height = bodies(90.0)
        assert bodies(9000.0)[0] == shapes
        assert height > 0.5 * HEIGHT


def test_colours_get_lighter_with_each_determined_parameter() -> None:
    def lightness(colour: str) -> float:
        red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    steps = [lightness(link_colour(count)) for count in range(11)]
    assert all(np.diff(steps) > 4)


class TestView:
    def test_is_small_and_valid(self, view) -> None:
        size = len(view.html) + len(view.style) + len(view.script)
        assert size < LARGEST
        Page(view.html)

    def test_names_of_links_cannot_end_the_script(self, model) -> None:
        parameters, estimate = drawn_estimate(model)
        scene = robot_scene(parameters, estimate)
        evil = replace(scene, name="</script><b>", remarks=("<i>",))
        page = Page(robot_view(evil).html)
        assert not {"b", "i"} & {tag for tag, attributes in page.elements if not attributes}

    @pytest.mark.parametrize(("width", "dark"), [(DESKTOP, False), (PHONE, True)])
    def test_turns_in_a_browser(self, browser, page_file, scene, width, dark) -> None:
        with browser.page(page_file, width, dark=dark) as page:
            tab = page.tab
            assert tab.locator(".robot-view.turnable canvas").is_visible()
            assert not tab.locator(".robot-still").is_visible()
            before = tab.locator("canvas").screenshot()
            canvas = tab.locator("canvas").bounding_box()
            middle = canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2
            tab.mouse.move(*middle)
            tab.mouse.down()
            tab.mouse.move(middle[0] + 80, middle[1], steps=4)
            tab.mouse.up()
            assert tab.locator("canvas").screenshot() != before
            tab.locator(".robot-view select").select_option(label=scene.links[3].name)
            table = tab.locator(".robot-numbers")
            assert scene.links[3].name in table.inner_text()
            assert scene.links[3].numbers[0][2] in table.inner_text()
            assert page.problems == page.overflow == page.requests == []

    def test_a_click_chooses_the_link_under_it(self, browser, page_file, scene) -> None:
        with browser.page(page_file) as page:
            canvas = page.tab.locator("canvas")
            place = page.tab.evaluate(
                """() => {
                  const view = document.querySelector('.robot-view').robotView;
                  const body = view.links[0].body;
                  view.camera.updateMatrixWorld();
                  const point = body.geometry.boundingSphere || (
                    body.geometry.computeBoundingSphere(), body.geometry.boundingSphere);
                  const seen = body.localToWorld(point.center.clone()).project(view.camera);
                  return [seen.x, seen.y];
                }"""
            )
            box = canvas.bounding_box()
            page.tab.mouse.click(
                box["x"] + (1 + place[0]) / 2 * box["width"],
                box["y"] + (1 - place[1]) / 2 * box["height"],
            )
            assert scene.links[0].name in page.tab.locator(".robot-numbers").inner_text()

    def test_without_scripts_the_still_picture_is_shown(self, browser, page_file) -> None:
        with browser.page(page_file, script=False) as page:
            assert page.tab.locator(".robot-picture").is_visible()
            assert not page.tab.locator("canvas").is_visible()

    def test_print_shows_the_still_picture(self, browser, page_file) -> None:
        with browser.page(page_file) as page:
            page.tab.emulate_media(media="print")
            assert page.tab.locator(".robot-picture").is_visible()
            assert not page.tab.locator("canvas").is_visible()
