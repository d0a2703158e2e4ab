"""A cluster of two workers, for all tests here."""

import pytest
from dask_cluster import local_cluster


@pytest.fixture(scope="session")
def cluster(tmp_path_factory: pytest.TempPathFactory):
    with local_cluster(tmp_path_factory.mktemp("dask")) as started:
        yield started
