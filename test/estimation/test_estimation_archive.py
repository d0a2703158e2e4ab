"""information.npz: written and read bit for bit; other files are rejected in one line."""

import io
import pickle
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gaussian_logs import gaussian_log, prior_of
from hypothesis import given, settings
from hypothesis import strategies as st

from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.archive import (
    FORMAT,
    SensorCalibration,
    load_archive,
    load_calibration,
    load_correlation,
    load_deviation_factor,
    write_archive,
)
from symbid_ros.estimation.group_moments import GroupMoments
from symbid_ros.estimation.posterior import posterior


def observed(seed=0):
    """Return observations over two windows, with a mask and noise in the motion."""
    log = gaussian_log(seed).with_noisy_regressor(np.random.default_rng(seed), 0.1)
    valid = log.valid.copy()
    valid[::3, -1] = False
    log = replace(log, valid=valid, inflation=4 / 3)
    return log.observations(), replace(log[::4], window=0.321).observations()


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Return the path of a valid archive."""
    path = tmp_path_factory.mktemp("archive") / "information.npz"
    write_archive(path, observed(), np.eye(30))
    return path


def test_an_archive_is_read_bit_for_bit(tmp_path):
    path = tmp_path / "information.npz"
    written = observed()
    factor = np.random.default_rng(0).normal(size=(30, 32))
    write_archive(path, written, factor)
    read = load_archive(path)
    assert len(read) == 2
    for one, other in zip(written, read, strict=True):
        for a, b in ((one.rows, other.rows), (one.noise, other.noise)):
            np.testing.assert_array_equal(a.factor, b.factor)
            assert a.samples == b.samples
            assert (a.layout.coordinates, a.layout.parameters) == (
                b.layout.coordinates,
                b.layout.parameters,
            )
            np.testing.assert_array_equal(a.layout.structure, b.layout.structure)
        np.testing.assert_array_equal(one.counts, other.counts)
        assert (one.window, one.inflation) == (other.window, other.inflation)
    np.testing.assert_array_equal(load_deviation_factor(path), factor)
    prior = prior_of(gaussian_log(0), 0)
    np.testing.assert_array_equal(posterior(read[0], prior).mean, posterior(written[0], prior).mean)
    assert path.stat().st_size < 2**20


def test_zeros_halves_of_moments_and_copies_are_not_stored(tmp_path):
    """A short log fills few rows of its factor, and no joint of it sticks."""
    log = gaussian_log(0, count=12, terms=("viscous", "coulomb"))
    groups = GroupMoments.empty(log.layout, candidates=True).fold([log.rows()])
    assert groups.complete
    one = replace(log.observations(), groups=groups)
    path = tmp_path / "information.npz"
    write_archive(path, [replace(one, slipping=one)])
    (read,) = load_archive(path)
    factor = one.rows.factor
    for found in (read, read.slipping):
        np.testing.assert_array_equal(found.rows.factor, factor)
        np.testing.assert_array_equal(found.noise.factor, one.noise.factor)
        for part, other in zip(found.groups.parts, groups.parts, strict=True):
            np.testing.assert_array_equal(part.moments, other.moments)
            np.testing.assert_array_equal(part.left, other.left)
    with np.load(path) as archive:
        numbers = sum(each.size for name, each in archive.items() if each.dtype == np.float64)
    everything = 2 * (log.layout.width**2 + sum(part.moments.size for part in groups.parts))
    assert numbers < 0.3 * everything


def test_loaded_observations_can_be_written_and_extended(tmp_path):
    path = tmp_path / "information.npz"
    one, two = observed(0)[0], observed(0)[0]
    write_archive(path, [one])
    (read,) = load_archive(path)
    both = read.merge(two)
    expected = one.merge(observed(0)[0])
    np.testing.assert_array_equal(both.rows.factor, expected.rows.factor)
    write_archive(path, [both])
    assert load_archive(path)[0].rows.samples == 2 * one.rows.samples
    assert load_deviation_factor(path) is None


def test_files_without_seconds_are_read():
    """The file was written by an earlier version, without the array of seconds."""
    path = Path(__file__).with_name("data") / "information_without_seconds.npz"
    log = gaussian_log(0, links=3, floating=False)
    log = log.with_noisy_regressor(np.random.default_rng(0), 0.1)
    log = replace(log, inflation=4 / 3)
    now = (log.observations(), replace(log[::4], window=0.321).observations())
    for one, other in zip(load_archive(path), now, strict=True):
        assert one.seconds == frozenset()
        assert (one.window, one.inflation, one.kept) == (other.window, other.inflation, 1.0)
        assert one.rows.samples == other.rows.samples
        np.testing.assert_array_equal(one.counts, other.counts)
        phi = log.truth + 1.0
        np.testing.assert_allclose(
            one.rows.residual_moment(phi), other.rows.residual_moment(phi), rtol=1e-9, atol=1e-9
        )
        assert one.merge(other.covering(frozenset({1, 2}))).seconds == {1, 2}
    np.testing.assert_array_equal(load_deviation_factor(path), np.eye(30))


def test_seconds_are_kept_and_joined(tmp_path):
    one, two = observed(0)[0].covering(frozenset({3, -4})), observed(0)[0]
    write_archive(tmp_path / "information.npz", [one.merge(two.covering(frozenset({3, 2**62})))])
    (read,) = load_archive(tmp_path / "information.npz")
    assert read.seconds == {3, -4, 2**62}


def refusal(read, path):
    """Return the error of a reader, or None if it reads the file."""
    try:
        read(path)
    except EstimateError as error:
        return str(error)
    return None


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_read_or_rejected_in_one_line(stored, data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    content = bytearray(stored.read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    for read in (load_archive, load_deviation_factor):
        said = refusal(read, path) or str(path)
        assert str(path) in said
        assert "\n" not in said


@settings(max_examples=40, deadline=None)
@given(place=st.integers(0, 10**6), change=st.integers(1, 255))
def test_a_single_wrong_byte_never_changes_the_content(stored, place, change, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "flipped.npz"
    content = bytearray(stored.read_bytes())
    content[place % len(content)] ^= change
    path.write_bytes(content)
    try:
        read = load_archive(path)
    except EstimateError:
        return
    for one, other in zip(read, observed(), strict=True):
        np.testing.assert_array_equal(one.rows.factor, other.rows.factor)
        np.testing.assert_array_equal(one.counts, other.counts)


@settings(max_examples=40, deadline=None)
@given(content=st.binary(max_size=300))
def test_other_files_are_rejected(content, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "anything.npz"
    path.write_bytes(content)
    with pytest.raises(EstimateError, match=r"anything\.npz"):
        load_archive(path)


def rewritten(stored, path, **changes):
    """Write the archive with some arrays replaced, or left out where None."""
    with np.load(stored) as archive:
        content = dict(archive)
    content |= changes
    np.savez(path, **{k: v for k, v in content.items() if v is not None})


WIDTH = (observed()[0].layout.width * (observed()[0].layout.width + 1) // 2 + 7) // 8
WRONG = {
    "an array missing": {"structure": None},
    "its rows missing": {"rows_1": None},
    "no format": {"format": None},
    "a format of another kind": {"format": np.array("one")},
    "too few numbers": {"rows_0": np.zeros(3)},
    "a number that is none": {"rows_0": np.array(np.nan)},
    "text for numbers": {"window": np.array(["short", "long"])},
    "more windows than rows": {"window": np.zeros(3), "inflation": np.ones(3)},
    "windows without inflation": {"inflation": np.ones(1)},
    "a flat structure": {"structure": np.ones(8, dtype=bool)},
    "a structure of other coordinates": {"coordinates": np.array(["one"])},
    "a structure of other parameters": {"parameters": np.array(["one"])},
    "counts of other coordinates": {"counts_0": np.ones((2, 2))},
    "counts that are no numbers": {"counts_0": np.full((8, 8), np.nan)},
    "samples that are no numbers": {"samples_0": np.array([np.nan, np.nan])},
    "one name for all": {"coordinates": np.array("one")},
    "a format beyond all": {"format": np.array(np.inf)},
    "a list of formats": {"format": np.array([2, 2])},
    "inflation that is NaN": {"inflation": np.array([4 / 3, np.nan])},
    "infinite inflation": {"inflation": np.array([np.inf, 4 / 3])},
    "negative inflation": {"inflation": np.array([-4 / 3, 4 / 3])},
    "inflation below that of white noise": {"inflation": np.array([1e-300, 4 / 3])},
    "complex inflation": {"inflation": np.array([4 / 3 + 1j, 4 / 3])},
    "a negative window": {"window": np.array([-0.081, 0.321])},
    "a window that is NaN": {"window": np.array([np.nan, 0.321])},
    "more weight than all": {"kept": np.array([1.0, 1.5])},
    "negative weight": {"kept": np.array([1.0, -0.5])},
    "weight that is NaN": {"kept": np.array([1.0, np.nan])},
    "negative counts": {"counts_0": -np.ones((8, 8))},
    "infinite counts": {"counts_0": np.full((8, 8), np.inf)},
    "complex counts": {"counts_0": np.ones((8, 8)) * 1j},
    "counts of one pair that differ": {"counts_0": np.triu(np.ones((8, 8)))},
    "pairs seen more often than each": {"counts_0": 2 - np.eye(8)},
    "negative samples": {"samples_0": np.array([-1, 60])},
    "complex samples": {"samples_0": np.array([60j, 60])},
    "seconds that are no integers": {"seconds": np.array([0.5])},
    "one second for all": {"seconds": np.array(5)},
    "bits of other rows": {"numbers_rows_0": np.zeros(3, dtype=np.uint8)},
    "bits that are numbers": {"numbers_rows_0": np.zeros(3)},
    "too few bits set": {"numbers_noise_1": np.zeros(WIDTH, dtype=np.uint8)},
    "more rows than there are": {"heights_0": np.array([3, 3])},
    "a negative number of rows": {"heights_0": np.array([-1, 3])},
    "a number of rows that is none": {"heights_0": np.array([3.0, 3.0])},
    "a shared array without an owner": {"shared": np.array(["rows_0"])},
    "a shared array of no window": {"shared": np.array(["rows_slipping_7"])},
}
COMPLEX = ("rows_0", "noise_1")
HUGE = (1e200, -1e308, np.inf, np.nan)


@pytest.mark.parametrize("name", COMPLEX)
def test_factors_are_real_and_bounded(name, stored, tmp_path):
    path = tmp_path / "wrong.npz"
    with np.load(stored) as archive:
        good = archive[name]
    for wrong in (good * 1j, *(np.append(good[:-1], number) for number in HUGE)):
        rewritten(stored, path, **{name: wrong})
        with pytest.raises(EstimateError, match=rf"wrong\.npz: not an information\.npz .*{name}"):
            load_archive(path)


@pytest.mark.parametrize("name", WRONG)
def test_invalid_content_is_rejected(name, stored, tmp_path):
    path = tmp_path / "wrong.npz"
    rewritten(stored, path, **WRONG[name])
    with pytest.raises(EstimateError, match=r"wrong\.npz: not an information\.npz") as caught:
        load_archive(path)
    assert "\n" not in str(caught.value)
    assert caught.value.code == "E410"


def test_another_format_version_is_named_with_its_fix(stored, tmp_path):
    path = tmp_path / "later.npz"
    rewritten(stored, path, format=np.array(FORMAT + 1))
    with pytest.raises(
        EstimateError, match=f"format {FORMAT + 1}, this version reads 2 to {FORMAT}; identify"
    ):
        load_archive(path)


class Told:
    """What a pickle would run."""

    ran = False

    def __reduce__(self):
        return setattr, (Told, "ran", True)


def test_no_pickle_is_ever_run(stored, tmp_path):
    path = tmp_path / "pickled.npz"
    path.write_bytes(pickle.dumps(Told()))
    with pytest.raises(EstimateError):
        load_archive(path)
    rewritten(stored, path, counts_0=np.array([Told()], dtype=object))
    with pytest.raises(EstimateError):
        load_archive(path)
    assert not Told.ran


def test_a_missing_file_and_a_folder_are_rejected(tmp_path):
    with pytest.raises(EstimateError, match=r"No such file.*check the path"):
        load_archive(tmp_path / "none.npz")
    with pytest.raises(EstimateError, match="check the path"):
        load_archive(tmp_path)
    single = tmp_path / "array.npz"
    with single.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(EstimateError, match=r"array\.npz"):
        load_archive(single)
    hollow = tmp_path / "hollow.npz"
    with zipfile.ZipFile(hollow, "w") as archive:
        archive.writestr("format.npy", "text")
    with pytest.raises(EstimateError, match=r"hollow\.npz"):
        load_archive(hollow)


def test_a_failed_write_keeps_the_earlier_file(stored, tmp_path, monkeypatch):
    path = tmp_path / "information.npz"
    path.write_bytes(stored.read_bytes())

    def full(stream, **content):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(SymbidError, match="No space left"):
        write_archive(path, observed())
    assert path.read_bytes() == stored.read_bytes()
    assert list(tmp_path.iterdir()) == [path]


def test_memory_is_not_allocated_beyond_an_arrays_bytes(stored, tmp_path):
    path = tmp_path / "lying.npz"
    with zipfile.ZipFile(stored) as good, zipfile.ZipFile(path, "w") as bad:
        for name in good.namelist():
            content = good.read(name)
            if name == "rows_0.npy":
                header = io.BytesIO()
                np.lib.format.write_array_header_1_0(
                    header, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
                )
                content = header.getvalue() + content[128:]
            bad.writestr(name, content)
    with pytest.raises(EstimateError, match="not an information"):
        load_archive(path)


def test_an_archive_beyond_the_unpacked_limit_is_rejected(stored, tmp_path, monkeypatch):
    limit = 64 << 20
    monkeypatch.setattr("symbid_ros.estimation.npz_file.MAX_BYTES", limit)
    path = tmp_path / "bomb.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("rows_0.npy", "w", force_zip64=True) as stream,
    ):
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "<f8", "fortran_order": False, "shape": (limit // 8,)}
        )
        for _ in range(limit >> 24):
            stream.write(bytes(1 << 24))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    with pytest.raises(EstimateError, match="64 MiB unpacked"):
        load_archive(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 22
    tracemalloc.stop()


def test_a_deviation_factor_is_a_finite_matrix(stored, tmp_path):
    path = tmp_path / "factor.npz"
    for factor in (np.zeros(3), np.full((2, 2), np.nan), np.array([["a"]])):
        rewritten(stored, path, deviation_factor=factor)
        with pytest.raises(EstimateError, match="its deviation_factor"):
            load_deviation_factor(path)


def test_a_calibration_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "information.npz"
    rng = np.random.default_rng(1)
    written = SensorCalibration(rng.normal(size=(4, 6)), rng.normal(size=34))
    write_archive(path, observed(), np.eye(30), written)
    found = load_calibration(path)
    np.testing.assert_array_equal(found.factor, written.factor)
    np.testing.assert_array_equal(found.linearization, written.linearization)
    assert len(load_archive(path)) == 2


@pytest.mark.parametrize(
    ("sensor_factor", "linearization", "error"),
    [
        (np.eye(2), np.ones(3), False),
        (np.ones(2), np.ones(3), True),
        (np.eye(2), np.eye(3), True),
        (np.full((2, 2), np.nan), np.ones(3), True),
        (np.eye(2), np.full(3, np.inf), True),
        (np.eye(2, dtype=int), np.ones(3), True),
        (np.eye(2), np.array(["a"]), True),
    ],
)
def test_a_calibration_consists_of_finite_arrays(
    stored, tmp_path, sensor_factor, linearization, error
):
    path = tmp_path / "calibration.npz"
    rewritten(stored, path, sensor_factor=sensor_factor, linearization=linearization)
    if error:
        with pytest.raises(EstimateError, match="its sensor_factor or linearization"):
            load_calibration(path)
    else:
        assert load_calibration(path).factor.shape == (2, 2)


def test_an_archive_without_sensor_errors_has_no_calibration(stored, tmp_path):
    assert load_calibration(stored) is None
    for name, value in (("sensor_factor", np.eye(2)), ("linearization", np.ones(3))):
        path = tmp_path / f"{name}.npz"
        rewritten(stored, path, **{name: value})
        assert load_calibration(path) is None


def test_the_correlation_of_residuals_is_read_as_written(tmp_path) -> None:
    path, observations = tmp_path / "information.npz", observed()
    write_archive(path, observations)
    assert load_correlation(path) is None
    n = len(observations[0].layout.coordinates)
    written = np.eye(n) + 0.5 * np.eye(n, k=1) + 0.5 * np.eye(n, k=-1)
    write_archive(path, observations, correlation=written)
    np.testing.assert_array_equal(load_correlation(path), written)
    for wrong in (written[1:], np.where(written == 1, np.nan, written)):
        write_archive(path, observations, correlation=wrong)
        with pytest.raises(EstimateError, match="row_correlation is not a finite matrix"):
            load_correlation(path)
