"""A cluster of two workers, for the tests of each file here."""

import pytest
from dask_cluster import local_cluster


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory):
    with local_cluster(tmp_path_factory.mktemp("dask")) as started:
        yield started
