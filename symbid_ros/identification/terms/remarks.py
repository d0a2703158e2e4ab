"""Remarks on what a robot or a log leaves open about joint terms, one sentence each."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.friction import COULOMB_SPEED
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.unmeasured_contacts import combined_coordinates
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import random_motions
from symbid_ros.model.held_joints import held_positions
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel

# Windows in which a joint slips, below which nothing is said about its friction.
FEWEST_SLIPPING = 25
# Share of a column's square that the other columns leave, below which they replace it.
REPLACED = 1e-8
ROUNDING = 1e-12  # largest column that counts as zero, relative to the largest of all


def held_remarks(model: RobotModel) -> tuple[str, ...]:
    """Return a sentence about links that are parts of others, as the log lacks their joints."""
    names = list(held_positions(model))
    if not names:
        return ()
    return (
        f"{len(names)} joints that the log lacks are rigid, from {names[0]} to {names[-1]}: each "
        "link beyond them is a part of the link that carries it",
    )


def resting_joints(slipping: Observations | None, parameters: ParameterSet) -> BoolArray:
    """Return which driven joints (d,) have too few rows in which they slip to judge friction."""
    if slipping is None:
        return np.zeros(len(parameters.joints), dtype=bool)
    rows = _rows_of_joints(slipping, parameters)
    is_driven = ~np.isin(parameters.joints, list(parameters.model.followers))
    few = slipping.counts.diagonal()[rows] < _needed_rows(slipping, parameters)
    return np.asarray(is_driven & few)


def _rows_of_joints(slipping: Observations, parameters: ParameterSet) -> IntArray:
    """Return the coordinate (d,) in whose rows the friction of each joint is seen most often.

    Unknown contacts leave combined rows, which contain the friction of all joints that they load.
    """
    model = parameters.model
    rows: IntArray = 6 * model.floating + parameters.joints
    combined = np.array(combined_coordinates(model), dtype=np.int64)
    if model.contacts is None or not len(combined):
        return rows
    most = combined[np.argmax(slipping.counts.diagonal()[combined])]
    is_loaded = np.asarray(model.contacts.loads.any(axis=0))[rows]
    return np.where(is_loaded, most, rows)


def _needed_rows(slipping: Observations, parameters: ParameterSet) -> FloatArray:
    """Return the rows (d,) of each joint without which its friction cannot be judged."""
    rows = _rows_of_joints(slipping, parameters)
    return np.maximum(slipping.needed_rows[rows], FEWEST_SLIPPING)


def resting_remarks(
    slipping: Observations | None, parameters: ParameterSet, resting: BoolArray, *, slips: bool
) -> tuple[str, ...]:
    """Return a sentence about the joints (d,) whose friction cannot be judged, for each unit.

    With ``slips``, only rows of slipping joints are used.
    """
    if slipping is None:
        return ()
    model, remarks = parameters.model, []
    needed = _needed_rows(slipping, parameters) * slipping.window / 2
    for unit, is_slide in (("rad/s", False), ("m/s", True)):
        kinds = [model.joints[joint].kind == "prismatic" for joint in parameters.joints]
        own = resting & (np.array(kinds, dtype=bool) == is_slide)
        if not own.any():
            continue
        names = ", ".join(model.joint_names[joint] for joint in parameters.joints[own])
        seconds, speed = needed[own].max(), COULOMB_SPEED[is_slide]
        if model.contacts is not None:  # a row contains the friction of several joints
            remarks.append(
                f"{names}: less than {seconds:.2g} s of usable rows in which most joints of a row "
                f"move faster than {speed:g} {unit}, too little to judge friction"
            )
            continue
        left_out = "; rows of slower motion are left out" if slips else ""
        remarks.append(
            f"{names}: moved faster than {speed:g} {unit} for less than {seconds:.2g} s, too "
            f"little to judge friction{left_out}"
        )
    return tuple(remarks)


def joints_without_rows(observations: Observations, parameters: ParameterSet) -> tuple[str, ...]:
    """Return a sentence about driven joints that have no row, because no effort was measured."""
    model = parameters.model
    rows = observations.counts.diagonal()[6 * model.floating :]
    own = [
        model.joint_names[index]
        for index in parameters.joints.tolist()
        if rows[index] == 0 and index not in model.followers
    ]
    if not own or not parameters.terms or model.contacts is not None:
        return ()
    their = "its" if len(own) == 1 else "their"
    return (
        f"{', '.join(own)}: no usable effort, so {their} friction, armature and offset remain "
        "unknown",
    )


def inseparable_terms(
    pairs: Sequence[tuple[int, int]], parameters: ParameterSet, free: BoolArray
) -> tuple[str, ...]:
    """Return a sentence about each pair of terms of which one was chosen."""
    joints: dict[tuple[str, str], list[str]] = {}
    for one, two in pairs:
        if free[one] or free[two]:
            joint, _, first = parameters.names[one].rpartition("/")
            second = parameters.names[two].rpartition("/")[2]
            joints.setdefault((first, second), []).append(joint)
    return tuple(
        f"{', '.join(names)}: this log cannot distinguish {first} from {second}"
        for (first, second), names in joints.items()
    )


def replaceable_terms(parameters: ParameterSet, free: BoolArray) -> tuple[str, ...]:
    """Return the chosen terms that act exactly like inertial parameters, one sentence each.

    Of several parameters that act alike, one with the term's unit is named, and the factor that is
    nearest to one.
    """
    count = parameters.inertial
    model = replace(parameters.model, contacts=None)
    parameters = replace(parameters, model=model)
    moments = 3 * len(parameters) // model.dof + 10
    samples = random_motions(model, moments)
    samples = replace(samples, stamp=parameters.typical_stamps(moments))
    K = equation_of_motion(parameters, samples).K
    K = K.reshape(-1, K.shape[2])
    terms = [i for i in range(count, parameters.sensor_offsets.start) if free[i]]
    if not terms:
        return ()
    scale = np.linalg.norm(K, axis=0)
    is_zero = scale <= ROUNDING * scale.max()
    K[:, is_zero], scale[is_zero] = 0.0, 1.0
    inertial = K[:, :count] / scale[:count]
    fit, *_ = np.linalg.lstsq(inertial, K[:, terms] / scale[terms], rcond=1e-10)
    rest = np.linalg.norm(inertial @ fit - K[:, terms] / scale[terms], axis=0)
    found = []
    names, units = parameters.names, parameters.units
    for index, term in enumerate(terms):
        if rest[index] ** 2 > REPLACED:
            continue
        cosine = inertial.T @ (K[:, term] / scale[term])
        twins = np.flatnonzero(1 - cosine**2 <= REPLACED).tolist()
        if not twins:
            likest = names[int(np.argmax(np.abs(cosine)))]
            found.append(
                f"{names[term]} acts like a combination of link parameters, including {likest}; "
                "the data cannot separate them"
            )
            continue
        factors = cosine * scale[term] / scale[:count]
        ranks = [(units[one] != units[term], abs(np.log(np.abs(factors[one])))) for one in twins]
        twin = min(zip(ranks, twins, strict=True))[1]
        factor = factors[twin]
        combination = "their sum"
        if not np.isclose(factor, 1.0):
            sign = "−" if factor < 0 else "+"
            combination = f"{names[twin]} {sign} {abs(factor):.3g} × {names[term]}"
        found.append(
            f"{names[term]} acts like {names[twin]}; the data determine only {combination}"
        )
    return tuple(found)
