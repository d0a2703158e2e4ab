"""Structure of the rows: which parameters affect which coordinates."""

import numpy as np
import pytest
from drive_logs import heavy_arm

from symbid_ros.choices import TERMS
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.model.parameters import ParameterSet


@pytest.mark.parametrize("terms", [("load",), TERMS])
def test_joint_terms_leave_the_structure_of_links_as_it_is(terms) -> None:
    """A first axis that is vertical up to rounding carries 4e-9 of the weight."""
    links = ParameterSet(heavy_arm())
    alone, beside = RowLayout.of(links), RowLayout.of(ParameterSet(links.model, terms))
    np.testing.assert_array_equal(beside.restricted(alone.parameters).structure, alone.structure)
