"""The compiled kernel equals the NumPy reference on every kind of robot."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_samples
from scipy.sparse import csr_array

from symbid_ros.dynamics import compiled_kernel
from symbid_ros.dynamics.compiled_kernel import FOLDER, load_kernel
from symbid_ros.dynamics.inertial_rows import (
    KERNEL,
    PackedLayout,
    averaged_rows,
    compile_kernel,
    packed_rows,
)
from symbid_ros.dynamics.kernel_arrays import LANES
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import OptionError
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Mimic


@st.composite
def problems(draw):
    """Draw parameters of a random tree, its samples and random windows of them."""
    links = draw(st.integers(1, 9))
    seed = draw(st.integers(0, 10_000))
    rng = np.random.default_rng(seed)
    floating = draw(st.booleans()) or links == 1
    model = random_robot(seed, links, floating=floating, wrench_frames=draw(st.integers(0, 3)))
    joints = [replace(joint, reference=rng.uniform(-1, 1)) for joint in model.joints]
    if len(joints) > 2 and draw(st.booleans()):
        joints[-1] = replace(
            joints[-1], mimic=Mimic(draw(st.integers(0, len(joints) - 2)), -0.7, 0.2)
        )
    virtual = draw(st.sets(st.integers(0, links - 1), max_size=links - 1))
    bodies = tuple(replace(one, virtual=i in virtual) for i, one in enumerate(model.links))
    model = replace(model, links=bodies, joints=tuple(joints))
    terms = draw(st.sampled_from([(), ("viscous", "coulomb", "armature")]))
    count = draw(st.sampled_from([1, 7, LANES, LANES + 9, 2 * LANES + 3]))
    samples = random_samples(model, count, rng)
    first = rng.integers(0, count, 5)
    length = rng.integers(0, count - first + 1)
    lanes = np.arange(count)
    inside = (lanes >= first[:, None]) & (lanes < (first + length)[:, None])
    return ParameterSet(model, terms), samples, csr_array(inside * rng.uniform(0.1, 1, count))


def assert_equal(some, others):
    for one, other in zip(some, others, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * np.abs(other).max(initial=1.0))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(problems())
def test_the_kernel_equals_numpy_on_random_trees(problem):
    parameters, samples, weights = problem
    layout = PackedLayout.of(parameters)
    results = []
    with pytest.MonkeyPatch.context() as patch:
        for choice in ("numpy", "numba"):
            patch.setenv(KERNEL, choice)
            rows = equation_of_motion(parameters, samples)
            packed = packed_rows(parameters, samples)
            phi = np.random.default_rng(0).normal(size=(2, parameters.inertial))
            averaged = averaged_rows(parameters, samples, weights, phi)
            results.append((rows.K, rows.y, *packed, *averaged))
    assert_equal(results[1], results[0])
    # Nothing but structural zeros is left out.
    alone = replace(
        parameters.model, joints=tuple(replace(j, mimic=None) for j in parameters.model.joints)
    )
    K = equation_of_motion(ParameterSet(alone, parameters.terms), samples).K
    K[:, layout.row, layout.column] -= results[1][2]
    assert_equal([K[:, :, : parameters.inertial]], [np.zeros(K[:, :, : parameters.inertial].shape)])


def test_angles_of_many_turns_and_missing_readings(monkeypatch):
    rng = np.random.default_rng(0)
    model = random_robot(0, 5)
    samples = random_samples(model, 90, rng)
    samples.position[:] *= 10.0 ** rng.uniform(0, 4, samples.position.shape)
    samples.effort[3, 1] = np.nan
    results = []
    for choice in ("numpy", "numba"):
        monkeypatch.setenv(KERNEL, choice)
        rows = equation_of_motion(ParameterSet(model), samples)
        results.append((rows.K, np.isnan(rows.y), np.nan_to_num(rows.y)))
    assert_equal(*results[::-1])


def test_read_only_and_transposed_arrays_are_accepted():
    rng = np.random.default_rng(1)
    model = random_robot(1, 4)
    samples = random_samples(model, 5, rng)
    odd = replace(samples, velocity=np.asfortranarray(samples.velocity))
    odd.effort.flags.writeable = False
    some, others = (equation_of_motion(ParameterSet(model), one) for one in (samples, odd))
    np.testing.assert_array_equal(some.K, others.K)


def test_an_unknown_kernel_is_refused(monkeypatch):
    monkeypatch.setenv(KERNEL, "fortran")
    with pytest.raises(OptionError, match="set it to numba or numpy") as caught:
        compile_kernel()
    assert caught.value.code == "E940"


def test_without_numba_the_error_names_the_alternative(tmp_path):
    (tmp_path / "numba.py").write_text("raise ImportError('broken')")
    code = "from symbid_ros.dynamics.inertial_rows import compile_kernel as c; c(); print('done')"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), FOLDER: str(tmp_path)}
    command = [sys.executable, "-c", code]
    failed = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "install numba, or set the environment variable SYMBID_KERNEL=numpy" in failed.stderr
    environment[KERNEL] = "numpy"
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("done\n", "")


def test_code_that_was_kept_needs_no_numba(tmp_path):
    (tmp_path / "numba.py").write_text("raise ImportError('broken')")
    load_kernel()  # compiled, unless it was kept
    code = "from symbid_ros.dynamics.inertial_rows import compile_kernel as c; c(); print('done')"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == ("done\n", "")


def test_damaged_code_is_compiled_again(tmp_path, monkeypatch, caplog):
    def compiled(kinds):
        raise ImportError("it would be compiled")

    content = b"name\n" + bytes(1000)
    monkeypatch.setenv(FOLDER, str(tmp_path))
    monkeypatch.setattr("symbid_ros.dynamics.kernel.compile_to_llvm", compiled)
    file = tmp_path / f"kernel-{compiled_kernel._fingerprint()}.o"
    compiled_kernel._write(file, content)
    assert compiled_kernel._read(file) == content
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(ImportError, match="would be compiled"):
        load_kernel.__wrapped__()
    assert f"kept in {tmp_path}" in caplog.text
