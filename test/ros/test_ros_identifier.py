"""The identifier of bags: its files and topics, against the command on the same bag."""

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from preloaded import run_symbid
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

ARCHIVES = {"information.npz", "report_data.npz"}
FILES = {"estimate.json", "model.urdf", "model.xml", *ARCHIVES}
LATCHED = QoSProfile(
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)


def command(bag: Path, out: Path, *options: object) -> dict[str, Any]:
    """Identify with the command and return estimate.json."""
    ended = run_symbid("identify", bag, *options, "--out", out, output=out.with_suffix(".symbid"))
    assert ended.returncode == 0, ended.stderr
    return json.loads((out / "estimate.json").read_text())


def same_arrays(one: Path, other: Path) -> bool:
    with np.load(one) as a, np.load(other) as b:
        return set(a) == set(b) and all(
            np.array_equal(a[key], b[key], equal_nan=a[key].dtype.kind == "f") for key in a
        )


def same_files(one: Path, other: Path) -> bool:
    """Compare all files of two identifications, but for who wrote them and when."""
    assert {file.name for file in one.iterdir()} == FILES == {f.name for f in other.iterdir()}
    arrays = all(same_arrays(one / name, other / name) for name in ARCHIVES)
    models = FILES - {"estimate.json", *ARCHIVES}
    same_models = all((one / f).read_text() == (other / f).read_text() for f in models)
    found, expected = (json.loads((out / "estimate.json").read_text()) for out in (one, other))
    for document in (found, expected):
        for name in ("command", "date", "versions"):
            assert document["provenance"].pop(name)
    return arrays and same_models and found == expected


def test_identification_by_the_node_equals_that_of_the_command(
    graph, simulated, tmp_path: Path
) -> None:
    bag = simulated("smooth", moves=1, motion_seed=21, noise_seed=5)
    model = config_file("symbitron.xml")
    parameters = ParameterSet(load_model(model))
    write_prior(tmp_path / "prior.json", draw_prior(parameters, "percent", 25, 4))
    given = {"model": model, "prior": tmp_path / "prior.json"}

    received: dict[str, object] = {}
    links = [link.name for link in parameters.model.links]
    topics = {
        "estimate": DiagnosticArray,
        "effort_residual": JointState,
        "wrench_residual": WrenchStamped,
        "robot_description": String,
        **{f"inertia/{link}": InertiaStamped for link in links},
        **{f"inertia_stddev/{link}": InertiaStamped for link in links},
    }
    identifier = graph.start("identifier", bag=f"['{bag}']", out=tmp_path / "node", **given)
    for topic, kind in topics.items():
        graph.node.create_subscription(
            kind,
            f"/identifier/{topic}",
            lambda message, topic=topic: received.__setitem__(topic, message),
            LATCHED,
        )
    graph.wait_until(lambda: len(received) == len(topics))
    identifier.send(signal.SIGINT)
    assert identifier.ended().status == 0

    options = [word for name, value in given.items() for word in (f"--{name}", value)]
    document = command(bag, tmp_path / "command", *options)
    assert same_files(tmp_path / "node", tmp_path / "command")
    assert document["method"] == "map_lmi"
    assert received["robot_description"].data == (tmp_path / "node" / "model.urdf").read_text()

    published = {
        f"{status.name}/{entry.key}": json.loads(entry.value)
        for status in received["estimate"].status
        for entry in status.values
    }
    for name, entry in document["parameters"].items():
        assert published[name] == entry["value"]
        assert published[f"{name}/std"] == entry["std"]
        assert published[f"{name}/determined"] is entry["determined"]
    values = {name: entry["value"] for name, entry in document["parameters"].items()}
    for link in links:
        inertia = received[f"inertia/{link}"].inertia
        assert inertia.m == values[f"{link}/m"]
        moment = [values[f"{link}/mc_{axis}"] for axis in "xyz"]
        com = np.array([inertia.com.x, inertia.com.y, inertia.com.z])
        np.testing.assert_allclose(com * inertia.m, moment, rtol=1e-12)
        # Parallel axis theorem: back to the link's origin.
        at_origin = inertia.izz + inertia.m * (com[0] ** 2 + com[1] ** 2)
        assert at_origin == pytest.approx(values[f"{link}/Izz"], rel=1e-9, abs=1e-12)
    residual = document["residual_rmse"]
    efforts = dict(
        zip(received["effort_residual"].name, received["effort_residual"].effort, strict=True)
    )
    assert efforts == {name: residual[name] for name in efforts}
    assert received["wrench_residual"].wrench.force.z == residual["base/force_z"]


def node_and_command(graph, tmp_path: Path, bag: Path, **given: object) -> dict[str, Any]:
    """Identify with node and command, whose results must be equal.

    True stands for a flag, a list for a repeated option."""
    model = config_file("symbitron.xml")
    parameters = {
        name: f"[{', '.join(map(repr, map(str, value)))}]" if isinstance(value, list) else value
        for name, value in given.items()
    }
    identifier = graph.start(
        "identifier", bag=f"['{bag}']", model=model, out=tmp_path / "node", **parameters
    )
    # The files are written before the topics; estimate.json is the last.
    received: list[DiagnosticArray] = []
    graph.node.create_subscription(
        DiagnosticArray, "/identifier/estimate", received.append, LATCHED
    )
    graph.wait_until(lambda: received)
    identifier.send(signal.SIGINT)
    assert identifier.ended().status == 0
    options: list[object] = ["--model", model]
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        for each in value if isinstance(value, list) else [value]:
            options += [option] if each is True else [option, each]
    document = command(bag, tmp_path / "command", *options)
    assert same_files(tmp_path / "node", tmp_path / "command")
    return document


def test_every_option_gives_the_same_result_as_the_command(graph, tmp_path: Path) -> None:
    errors = {"errors": "typical", "error_seed": 3}
    record(Simulator(SimulateOptions("smooth", moves=1, motion_seed=7, **errors)), tmp_path / "bag")
    tare = Simulator(SimulateOptions("tare", **errors))
    tare.steps = 1000
    record(tare, tmp_path / "tare")
    document = node_and_command(
        graph,
        tmp_path,
        tmp_path / "bag",
        tare=[tmp_path / "tare"],
        sensor_errors="wrench_offset, torque_gain",
        total_mass=41.05,
        total_mass_std=0.02,
        prior_percent=20.0,
        mirror=0.5,
        offset=True,
        no_holdout=True,
    )
    assert str(tmp_path / "tare") in document["inputs"]
    kinds = {sensor["name"].split("/")[1] for sensor in document["verdict"]["sensors"]}
    assert {kind.split("_")[0] for kind in kinds} == {"wrench", "torque"}
    assert document["parameters"]["L_kfe/offset"]["determined"]


def test_a_truncated_method_on_filtered_rows_is_the_same_from_both(
    graph, simulated, tmp_path: Path
) -> None:
    document = node_and_command(
        graph,
        tmp_path,
        simulated("smooth", moves=1, motion_seed=21, noise_seed=5),
        method="wls_rc",
        choose_truncation=simulated("smooth", moves=1, motion_seed=22, ideal=True),
        select_by="torque",
        filter="butterworth",
        cutoff=25.0,
        channels="thesis",
        friction=True,
        armature=True,
        no_holdout=True,
    )
    assert document["method"] == "wls_rc"
    assert document["rank"] >= 1
    assert {"L_kfe/viscous", "L_kfe/coulomb", "L_kfe/armature"} <= set(document["parameters"])


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"total_mass": -41.0}, "parameter total_mass: -41.0 is not valid"),
        ({"sensor_errors": "wrench_offse"}, "parameter sensor_errors: 'wrench_offse'"),
        ({"rank": 5, "choose_truncation": "log"}, "both choose the singular values"),
        ({"filter": "weak", "window": -1.0}, "parameter window"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_an_invalid_parameter_is_refused(graph, tmp_path: Path, parameters, says) -> None:
    identifier = graph.start(
        "identifier",
        bag=f"['{tmp_path / 'bag'}']",
        model=config_file("symbitron.xml"),
        out=tmp_path / "out",
        **parameters,
    )
    ended = identifier.ended()
    assert ended.status == 2
    assert ended.err.count("\n") == 1, ended.err
    assert says in ended.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_an_earlier_result_is_refused_at_the_start(graph, tmp_path: Path, mode: str) -> None:
    (tmp_path / "estimate.json").write_text("earlier")
    given = {"bag": tmp_path / "bag"} if mode == "offline" else {}
    identifier = graph.start(
        "identifier", model=config_file("symbitron.xml"), out=tmp_path, mode=mode, **given
    )
    ended = identifier.ended()
    assert ended.status == 2
    assert ended.err.count("\n") == 1, ended.err
    assert "holds an earlier estimate.json; choose another `out`, or give `overwrite`" in ended.err
    assert (tmp_path / "estimate.json").read_text() == "earlier"


def test_an_earlier_result_is_replaced_if_wanted(graph, simulated, tmp_path: Path) -> None:
    (tmp_path / "estimate.json").write_text("earlier")
    identifier = graph.start(
        "identifier",
        model=config_file("symbitron.xml"),
        bag=simulated("smooth", moves=1, motion_seed=21, noise_seed=5),
        out=tmp_path,
        overwrite=True,
        method="map",
    )
    received: list[DiagnosticArray] = []
    graph.node.create_subscription(
        DiagnosticArray, "/identifier/estimate", received.append, LATCHED
    )
    graph.wait_until(lambda: received)
    identifier.send(signal.SIGINT)
    assert identifier.ended().status == 0
    assert json.loads((tmp_path / "estimate.json").read_text())["method"] == "map"
