"""FIGAROH on one problem of bench/peers.py: its own loader, filter, regressor, WLS and LMI fit.

    python figaroh_peer.py FOLDER

FOLDER holds model.urdf, training.npz and heldout.npz (see bench/peers.py). Writes figaroh.npz with
the torques of the held-out motion. The configuration asks for everything that FIGAROH 1.0 offers
for such logs: friction, offsets and motor inertias, weighted least squares, and a physically
consistent fit ("physical_fit"); when it rejects that, its base parameters predict.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pinocchio
import yaml
from figaroh.identification.base_identification import BaseIdentification
from figaroh.tools.regressor import build_regressor_basic, build_regressor_reduced
from figaroh.tools.robot import load_robot

# user: begin
CUTOFF = 10.0  # Hz
SLIPPING = 0.05  # rad/s; slower joints may stick


class Identification(BaseIdentification):
    def __init__(self, robot, config):
        super().__init__(robot, config)
        self.identif_config["act_idxq"] = list(range(self.model.nq))
        self.identif_config["act_idxv"] = list(range(self.model.nv))

    def load_trajectory_data(self, data_source=None):
        data = np.load("training.npz")
        names = list(data["joints"])
        order = [names.index(name) for name in self.identif_config["active_joints"]]
        return {
            "timestamps": data["time"],
            "positions": data["position"][:, order],
            "velocities": None,
            "accelerations": None,
            "torques": data["effort"][:, order],
        }

    def process_data(self, truncate=None):
        super().process_data(truncate)
        slow = np.abs(self.processed_data["velocities"]) < SLIPPING
        self._sample_mask = ~slow.any(axis=1)

    def process_torque_data(self):
        return self._apply_filters(self.raw_data["torques"], **self.filter_config["filter_params"])


def configuration(model, rate):
    joints = list(model.names[1:])
    none = [0.0] * len(joints)
    return {
        "robot": {
            "name": "robot",
            "properties": {
                "joints": {"active_joints": joints},
                "mechanics": {
                    "reduction_ratios": [1.0] * len(joints),
                    "friction_coefficients": {"viscous": none, "static": none},
                    "actuator_inertias": none,
                    "joint_offsets": none,
                },
                "coupling": {"has_coupled_wrist": False},
            },
        },
        "tasks": {
            "identification": {
                "enabled": True,
                "problem": {
                    "use_joint_torques": True,
                    "model_components": {
                        "friction": True,
                        "actuator_inertia": True,
                        "joint_offset": True,
                    },
                },
                "signal_processing": {
                    "sampling_frequency": rate,
                    "cutoff_frequency": CUTOFF,
                    "filter_order": 4,
                },
                "select_stage": "physical_fit",
                "physical_fit": {"enabled": True, "max_seconds": 120},
            }
        },
    }


def identify():
    robot = load_robot("model.urdf", package_dirs=".", load_by_urdf=True)
    rate = 1.0 / float(np.median(np.diff(np.load("training.npz")["time"])))
    config = configuration(robot.model, rate)
    Path("figaroh.yaml").write_text(yaml.safe_dump(config))
    found = Identification(robot, "figaroh.yaml")
    found.initialize()
    found.solve(decimate=True, decimation_factor=5, plotting=False, wls=True)
    return found


# user: end


def predict(found):
    """Return the held-out torques (N, J) in the log's order of joints."""
    data = np.load("heldout.npz")
    names = list(data["joints"])
    model = found.robot.model
    order = [names.index(name) for name in model.names[1:]]
    motion = [data[key][:, order] for key in ("position", "velocity", "acceleration")]
    full = build_regressor_basic(found.robot, *motion, found.identif_config)
    if found.selected is not None and found.selected.accepted:
        torque = found.selected.predict(full)
    else:
        reduced = build_regressor_reduced(full, found._idx_eliminated)
        torque = reduced[:, found._base_indices] @ found.phi_base
    torque = torque.reshape(len(order), -1).T
    result = np.empty_like(torque)
    result[:, order] = torque
    return result


def impossible_links(found):
    """Return how many links the standard parameters make impossible, -1 without any."""
    if found.selected is None or not found.selected.accepted:
        return -1
    return sum(not each["ok"] for each in found.selected.feasibility.values())


if __name__ == "__main__":
    import os

    os.chdir(sys.argv[1])
    start = time.perf_counter()
    found = identify()
    seconds = time.perf_counter() - start
    np.savez(
        "figaroh.npz",
        torque=predict(found),
        impossible=impossible_links(found),
        seconds=seconds,
        note=str(found.selected.reason if found.selected is not None else ""),
        version=pinocchio.__version__,
    )
