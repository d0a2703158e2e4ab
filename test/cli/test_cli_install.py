"""`symbid diff` and `symbid apply`: tables, files, and what is refused."""

import json

import pytest
from documented_robots import ur5_urdf
from json_schemas import require_valid
from written_results import write_result

from symbid_ros.cli.install import print_change
from symbid_ros.identification.link_changes import Change, LinkChange, RobotChange
from symbid_ros.model.load import load_model


@pytest.fixture(scope="module")
def found(symbid_here, model, short, tmp_path_factory):
    out = tmp_path_factory.mktemp("found") / "result"
    options = ("--prior-percent", 25, "--no-holdout", "--joint-terms", "viscous", "--out", out)
    ended = symbid_here("identify", short, "--model", model, *options)
    assert ended.returncode == 0
    return out


@pytest.fixture
def arm(tmp_path):
    robot = tmp_path / "robot.urdf"
    robot.write_bytes(ur5_urdf().read_bytes())
    write_result(tmp_path / "result", robot, base="fixed")
    return tmp_path


def test_deviations_are_those_of_the_estimate(symbid_here, found) -> None:
    ended = symbid_here("diff", found, "--json")
    assert (ended.returncode, ended.stderr) == (0, "")
    told = json.loads(ended.stdout)
    require_valid("difference", told)
    parameters = json.loads((found / "estimate.json").read_text())["parameters"]
    for link in told["links"]:
        entry = parameters[f"{link['name']}/m"]
        assert link["mass_kg"]["before"] == [entry["prior"]]
        assert link["mass_kg"]["after"] == [entry["value"]]
        assert link["mass_kg"]["std"] == [entry["std"]]
        assert all(std > 0 for std in link["principal_inertia_kg_m2"]["std"])
    names = {term["name"] for term in told["joint_terms"]}
    assert "R_kfe/viscous" in names


def test_a_terminal_of_another_encoding_shows_what_it_can(symbid, found, monkeypatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    ended = symbid("diff", found)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "R_shank" in ended.stdout


def test_a_star_marks_what_changed_where_nothing_is_bold(capsys) -> None:
    def link(name: str, size: float) -> LinkChange:
        std = (0.01 * size,) * 3
        moments = Change((size, 2 * size, 2 * size), (size, 2.1 * size, 2 * size), std)
        centre = Change((0.0, 0.1, 0.2), (0.0, 0.1, 0.21), (0.001,) * 3)
        return LinkChange(name, Change((4.0,), (3.5,), (0.1,)), centre, moments, 5)

    links = link("thigh", 0.2), link("foot", 0.001)
    print_change(RobotChange("result", "robot", "map_lmi", links, ()))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    marked = [" ".join(words[:-3]) for words in lines if len(words) > 3 and words[-2][0] == "*"]
    assert marked == ["mass kg", "CoM z mm", "I2 g m²"] * 2  # one unit for small and large links


def test_the_table_fits_a_narrow_terminal(symbid_here, found) -> None:
    ended = symbid_here("diff", found, columns=40)
    assert (ended.returncode, ended.stderr) == (0, "")
    lines = ended.stdout.splitlines()
    note = lines.index(next(line for line in lines if line.startswith("I1, I2, I3")))
    assert max(map(len, lines[:note])) <= 40
    masses = [line for line in lines if line.split()[:2] == ["mass", "kg"]]
    assert len(masses) == 11
    assert all("…" not in line for line in lines)


def test_a_file_is_changed_and_kept(symbid_here, arm) -> None:
    before = (arm / "robot.urdf").read_bytes()
    ended = symbid_here("apply", arm / "result", arm / "robot.urdf")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert f"kept {arm / 'robot.urdf.orig'}\nwrote {arm / 'robot.urdf'}\n" in ended.stdout
    assert (arm / "robot.urdf.orig").read_bytes() == before
    again = symbid_here("apply", arm / "result", arm / "robot.urdf")
    assert "holds these parameters already" in again.stdout


def test_other_files_are_written_and_not_replaced(symbid_here, arm) -> None:
    before = (arm / "robot.urdf").read_bytes()
    words = ("apply", arm / "result", arm / "robot.urdf", "--out", arm / "new.urdf")
    words += ("--xacro-yaml", arm / "inertials.yaml")
    assert symbid_here(*words).returncode == 0
    assert (arm / "robot.urdf").read_bytes() == before
    masses = [link.phi[0] for link in load_model(arm / "new.urdf", "fixed").links]
    assert masses != [link.phi[0] for link in load_model(arm / "robot.urdf", "fixed").links]
    refused = symbid_here(*words)
    assert refused.returncode == 2
    assert "exists; choose another name, or give --overwrite (SYMBID-E551)" in refused.stderr
    assert symbid_here(*words, "--overwrite").returncode == 0


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((), "name the robot's file, or give --xacro-yaml FILE (SYMBID-E577)"),
        (("--out", "new.urdf"), "(SYMBID-E577)"),
        (("robot.urdf.xacro",), "give --xacro-yaml FILE instead"),
        (("missing.urdf",), "(SYMBID-E101)"),
    ],
)
def test_errors_are_one_line_and_status_2(symbid_here, arm, words, named) -> None:
    ended = symbid_here("apply", arm / "result", *words)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert named in ended.stderr
    assert ended.stderr.count("\n") == 1
